"""Exact rigid kinematics of boundary parts. A part's body frame is its pose at t = 0."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.scene.scene import Motion
from gns_pyg.scene.travel import travel
from gns_pyg.state import constant

STEP_S = 1e-30  # of the complex-step derivative: no difference is taken, so it cannot be too small


def turn(
    motion: Motion, vectors: Float[Tensor, "n 3"], time_s: Float[Tensor, " n"], *, back: bool = False
) -> Float[Tensor, "n 3"]:
    """Turns directions, each at its own time, from the body frame into the world, or `back` (Rodrigues' formula)."""
    if motion.kind != "rotation":
        return vectors
    axis, angle = _axis(motion, vectors), way(motion, time_s)[0][:, None]
    cos, sin = torch.cos(angle), torch.sin(-angle if back else angle)
    along = (vectors * axis).sum(1, keepdim=True) * axis
    return vectors * cos + torch.linalg.cross(axis.expand_as(vectors), vectors) * sin + along * (1 - cos)


def way(motion: Motion, time_s: Float[Tensor, " b"]) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """How far a part has come at each time (rad or m) and how fast it moves (rad/s or m/s).

    The speed is the complex-step derivative (Squire and Trapp 1998): exact for the analytic functions of `travel`.
    """
    step = torch.complex(time_s, torch.full_like(time_s, STEP_S))
    stepped = travel(motion, step, torch) + torch.zeros_like(step)  # a constant function has no shape of its own
    return stepped.real, stepped.imag / STEP_S


def to_world(
    motion: Motion, points: Float[Tensor, "n 3"], time_s: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Places body-frame points, each at its own time; returns their world positions, m, and velocities, m/s."""
    if not motion.moves:
        return points, torch.zeros_like(points)
    come, speed = (value[:, None] * _axis(motion, points) for value in way(motion, time_s))
    if motion.kind != "rotation":
        return points + come, speed
    origin = constant(motion.origin_m, points)
    arm = turn(motion, points - origin, time_s)
    return arm + origin, torch.linalg.cross(speed, arm)


def to_body(motion: Motion, pos: Float[Tensor, "n 3"], time_s: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Takes world positions, each at its own time, into the part's body frame; inverse of `to_world`."""
    if not motion.moves:
        return pos
    if motion.kind != "rotation":
        return pos - way(motion, time_s)[0][:, None] * _axis(motion, pos)
    origin = constant(motion.origin_m, pos)
    return turn(motion, pos - origin, time_s, back=True) + origin


def _axis(motion: Motion, like: Tensor) -> Tensor:
    length = math.hypot(*motion.axis)
    return constant([value / length for value in motion.axis], like)

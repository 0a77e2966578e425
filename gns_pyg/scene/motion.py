"""Exact rigid kinematics of boundary parts. A part's body frame is its pose at t = 0."""

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.scene.scene import Motion
from gns_pyg.scene.travel import travel

STEP_S = 1e-30  # of the complex-step derivative: no difference is taken, so it cannot be too small


def rotation(motion: Motion, time_s: Float[Tensor, " b"]) -> Float[Tensor, "b 3 3"]:
    """Rotation from the body frame to the world frame at each time (Rodrigues' formula)."""
    eye = torch.eye(3, dtype=time_s.dtype, device=time_s.device).expand(len(time_s), 3, 3)
    if motion.kind != "rotation":
        return eye
    x, y, z = _axis(motion, time_s).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=time_s.dtype, device=time_s.device)
    angle = way(motion, time_s)[0][:, None, None]
    return eye + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)


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
    origin = _origin(motion, points)
    arm = torch.einsum("nij,nj->ni", rotation(motion, time_s), points - origin)
    return arm + origin, torch.linalg.cross(speed, arm)


def to_body(motion: Motion, pos: Float[Tensor, "n 3"], time_s: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Takes world positions, each at its own time, into the part's body frame; inverse of `to_world`."""
    if not motion.moves:
        return pos
    if motion.kind != "rotation":
        return pos - way(motion, time_s)[0][:, None] * _axis(motion, pos)
    origin = _origin(motion, pos)
    return torch.einsum("nji,nj->ni", rotation(motion, time_s), pos - origin) + origin


def _axis(motion: Motion, like: Tensor) -> Tensor:
    axis = torch.tensor(motion.axis, dtype=like.dtype, device=like.device)
    return axis / axis.norm()


def _origin(motion: Motion, like: Tensor) -> Tensor:
    return torch.tensor(motion.origin_m, dtype=like.dtype, device=like.device)

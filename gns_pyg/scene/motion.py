"""Exact rigid kinematics of boundary parts. A part's body frame is its pose at t = 0."""

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.scene.scene import Motion


def rotation(motion: Motion, time_s: Float[Tensor, " b"]) -> Float[Tensor, "b 3 3"]:
    """Rotation from the body frame to the world frame at each time (Rodrigues' formula)."""
    eye = torch.eye(3, dtype=time_s.dtype, device=time_s.device).expand(len(time_s), 3, 3)
    if not motion.moves:
        return eye
    x, y, z = _axis(motion, time_s).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=time_s.dtype, device=time_s.device)
    angle = (motion.rate_rad_s * time_s)[:, None, None]
    return eye + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)


def to_world(
    motion: Motion, points: Float[Tensor, "p 3"], time_s: Float[Tensor, " b"]
) -> tuple[Float[Tensor, "b p 3"], Float[Tensor, "b p 3"]]:
    """Places body-frame points at each time; returns their world positions, m, and velocities, m/s."""
    origin = _origin(motion, points)
    arm = (points - origin) @ rotation(motion, time_s).transpose(1, 2)
    if not motion.moves:
        return arm + origin, torch.zeros_like(arm)
    spin = (motion.rate_rad_s * _axis(motion, points)).expand_as(arm)
    return arm + origin, torch.linalg.cross(spin, arm)


def to_body(motion: Motion, pos: Float[Tensor, "n 3"], time_s: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Takes world positions, each at its own time, into the part's body frame; inverse of `to_world`."""
    if not motion.moves:
        return pos
    origin = _origin(motion, pos)
    return torch.einsum("nji,nj->ni", rotation(motion, time_s), pos - origin) + origin


def _axis(motion: Motion, like: Tensor) -> Tensor:
    axis = torch.tensor(motion.axis, dtype=like.dtype, device=like.device)
    return axis / axis.norm()


def _origin(motion: Motion, like: Tensor) -> Tensor:
    return torch.tensor(motion.origin_m, dtype=like.dtype, device=like.device)

"""The law a grain follows when it touches nothing, gravity with the DEM's own damping, and that damping alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.scene.scene import Scene
from gns_pyg.state import constant


def free_flight(
    pos: Float[Tensor, "n 3"],
    vel: Float[Tensor, "n 3"],
    scene: Scene,
    dt_s: float,
    damping: Float[Tensor, " n"] | None = None,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Moves free grains by `dt_s`, exactly.

    Cundall's damping acts on each component of the resultant force (Yade's NewtonIntegrator): with gravity included a
    component g is felt as g (1 - damping) while it speeds the grain up and g (1 + damping) while it slows it
    down. The turning point, where one becomes the other, may lie inside the step.

    Args:
        pos: grain centres, m.
        vel: instantaneous velocity, m/s.
        scene: gives gravity and damping.
        dt_s: time to move, s.
        damping: of each grain, where it varies; the scene's when None.

    Returns:
        Position and velocity after `dt_s`.
    """
    gravity = constant(scene.gravity_m_s2, pos)
    felt = torch.full_like(pos[:, :1], scene.damping) if damping is None else damping[:, None].to(pos.dtype)
    felt = felt if scene.damping_on_gravity else torch.zeros_like(felt)
    slowing, speeding = gravity * (1 + felt), gravity * (1 - felt)
    against = vel * gravity < 0
    until_turn = torch.where(against, -vel / torch.where(slowing == 0, 1.0, slowing), 0.0).clamp(max=dt_s)
    rest = dt_s - until_turn
    turn_vel = vel + slowing * until_turn
    turn_pos = pos + (vel + turn_vel) / 2 * until_turn
    end_vel = turn_vel + speeding * rest
    return turn_pos + (turn_vel + end_vel) / 2 * rest, end_vel


def cundall(
    vel: Float[Tensor, "*k n 3"], gained: Float[Tensor, "*k n 3"], damping: Float[Tensor, "n 1"]
) -> Float[Tensor, "*k n 3"]:
    """What Cundall's damping adds to velocities that one steady force takes from `vel` to `vel` + `gained`: a component
    gains less where the force speeds it up, and loses more where the force slows it down (see `free_flight`).

    Args:
        vel: any unit.
        gained: without damping, in that unit.
        damping: of each grain.
    """
    against = vel * gained < 0
    slowing = torch.where(against, -vel / torch.where(against, (1 + damping) * gained, 1.0), 0.0).clamp(max=1.0)
    return damping * gained * (2 * slowing - 1)  # of the time, the part before the turning point slows

"""From a correction to the next state, and back: `target` is the exact inverse of `integrate`.

A correction is what contacts add to what a grain would do without them, in columns of three:
mean velocity over the step (m/s), then, if the state holds them, end velocity (m/s) and angular velocity (rad/s).
Without `free_flight` the first group is the mean velocity itself, as in the paper.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gns_pyg.config import require
from gns_pyg.dynamics import memory as mean_motion
from gns_pyg.scene.free_flight import free_flight
from gns_pyg.scene.scene import PARAMETERS, STATES, Scene
from gns_pyg.state import State, Window


class Integrator:
    """Moves a state by one frame.

    Args:
        scene: gives the free-flight law and the frame step.
        state: what a state holds. `differences`: position and (x(t) - x(t - dt)) / dt, as in the paper; `velocity`:
            position and instantaneous velocity; `full`: angular velocity too.
        free_flight: corrections are taken relative to free flight; else relative to standing still.
        memory: frames over which the mean motion of a grain is a part of the state; 0: it is not.
    """

    def __init__(self, scene: Scene, state: str, *, free_flight: bool, memory: int = 0) -> None:
        require(state in STATES, "requires.state", state, " or ".join(STATES), "pick one of them")
        self.scene, self.state, self.free_flight, self.memory = scene, state, free_flight, memory
        self.dt_s = scene.frame_dt_s
        self.n_groups = 1 + STATES.index(state)

    def before(self, steps: int = 1) -> int:
        """Recorded frames, each `steps` steps after the last, that a state is read from beside its own."""
        return max(1, math.ceil(mean_motion.FRAMES * self.memory / steps))

    def read(self, window: Window, frame: int, steps: int = 1) -> State:
        """The state at `frame` of a window, whose frames are `steps` steps apart; `differences` also reads the frame
        before, `memory` as many as there are of those that `before` says."""
        drift = None
        if self.memory:
            way = window.pos[max(0, frame - self.before(steps)) : frame + 1]
            drift = mean_motion.recorded(way, max(1.0, self.memory / steps), steps * self.dt_s)
        if self.state == "differences":
            vel = (window.pos[frame] - window.pos[frame - 1]) / self.dt_s
        else:
            vel = window.vel[frame]
        return State(
            pos=window.pos[frame],
            vel=vel,
            ang_vel=window.ang_vel[frame] if self.state == "full" else None,
            radius=window.radius,
            time_s=window.time_s + frame * steps * self.dt_s,
            batch=window.batch,
            parameters=window.parameters,
            active=None if window.active is None else window.active[frame],
            drift=drift,
        )

    def without_contact(self, state: State) -> State:
        """Where the state would be one frame later if nothing touched (`free_flight`), or if it stood still."""
        later = state.time_s + self.dt_s
        if not self.free_flight:
            still = torch.zeros_like(state.vel)
            return replace(state, vel=still, ang_vel=None if state.ang_vel is None else still, time_s=later)
        pos, vel = free_flight(state.pos, state.vel, self.scene, self.dt_s, self.damping(state))
        if self.state == "differences":  # the mean velocity of one frame passes into that of the next
            pos = state.pos + vel * self.dt_s
        return replace(state, pos=pos, vel=vel, time_s=later)

    def gained(self, state: State) -> Float[Tensor, " n_grains"]:
        """Speed of each grain after a frame of free flight from rest, m/s."""
        felt = self.damping(state) if self.scene.damping_on_gravity else 0.0
        per_s = math.hypot(*self.scene.gravity_m_s2) if self.free_flight else 0.0
        return torch.full_like(state.pos[:, 0], per_s * self.dt_s) * (1 - felt)

    def damping(self, state: State) -> Float[Tensor, " n_grains"]:
        """Of each grain: its case's own where cases vary, else the scene's."""
        if state.parameters is not None:
            return state.parameters[state.batch, PARAMETERS.index("damping")]
        return torch.full_like(state.pos[:, 0], self.scene.damping)

    def integrate(self, state: State, correction: Float[Tensor, "n_grains d"]) -> State:
        """The next state, one frame later (the paper's equation (11) for `differences`)."""
        free = self.without_contact(state)
        mean, *rest = correction.to(state.pos.dtype).split(3, dim=1)
        pos = free.pos + mean * self.dt_s
        if self.state == "differences":
            return replace(free, pos=pos, vel=(pos - state.pos) / self.dt_s)
        ang_vel = free.ang_vel + rest[1] if self.state == "full" and free.ang_vel is not None else None
        return replace(free, pos=pos, vel=free.vel + rest[0], ang_vel=ang_vel)

    def target(self, state: State, following: State) -> Float[Tensor, "n_grains d"]:
        """The correction that takes `state` to `following`."""
        free = self.without_contact(state)
        groups = [(following.pos - free.pos) / self.dt_s]
        if self.state != "differences":
            groups.append(following.vel - free.vel)
        if free.ang_vel is not None and following.ang_vel is not None:
            groups.append(following.ang_vel - free.ang_vel)
        return torch.cat(groups, dim=1)

"""Grains that leave through a scene's outlet or enter through its inlet: fixed slots, an `active` mask."""

from dataclasses import replace

import torch

from gns_pyg.scene.inlet import entries
from gns_pyg.scene.scene import Scene
from gns_pyg.state import State, constant

EARLY_S = 1e-9  # an entry at a frame's own time belongs to that frame


class Passage:
    """Applies a scene's outlet and inlet after a step, as data generation does at every frame.

    A slot that is not active rests where its grain left, or where it will enter.
    """

    def __init__(self, scene: Scene) -> None:
        self.outlet, self.n_grains = scene.outlet, scene.grains.count
        plan = entries(scene)
        self.entry_time_s, self.entry_pos, self.entry_vel = map(torch.from_numpy, (plan.time_s, plan.pos, plan.vel))

    def __call__(self, before: State, after: State) -> State:
        """`after` with everyone who left or entered on the way from `before`."""
        if before.active is None:
            return after
        active = before.active
        pos = torch.where(active[:, None], after.pos, before.pos)
        vel = torch.where(active[:, None], after.vel, 0.0)
        if self.outlet is not None:
            point, normal = constant(self.outlet.point_m, pos), constant(self.outlet.normal, pos)
            gone = active & ((pos - point) @ normal > 0)
            active, vel = active & ~gone, torch.where(gone[:, None], 0.0, vel)
        n = len(self.entry_time_s)
        if n:
            slot = torch.arange(len(pos), device=pos.device) % self.n_grains - (self.n_grains - n)
            if self.entry_pos.device != pos.device:  # once
                fields = ("entry_time_s", "entry_pos", "entry_vel")
                self.__dict__.update({name: getattr(self, name).to(pos.device) for name in fields})
            entry = slot.clamp(min=0)
            time_s = self.entry_time_s[entry]
            enters = (slot >= 0) & (time_s > before.time_s[before.batch] + EARLY_S)
            enters &= time_s <= after.time_s[after.batch] + EARLY_S
            pos = torch.where(enters[:, None], self.entry_pos[entry], pos)
            vel = torch.where(enters[:, None], self.entry_vel[entry], vel)
            active = active | enters
        still = None if after.ang_vel is None else torch.where((before.active & active)[:, None], after.ang_vel, 0.0)
        return replace(after, pos=pos, vel=vel, ang_vel=still, active=active)

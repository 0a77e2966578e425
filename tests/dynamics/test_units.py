"""The same scene in other units, and far from the origin: the same dimensionless motion."""

from dataclasses import replace

import pytest
import torch

from tests import scenes
from tests.simulators import STATISTICS, simulator, state_in_box

BASE_M = 0.01


def scaled(radius_m: float, dtype: torch.dtype = torch.float64, center_m: float = 0.0):
    """A box of 15 radii that the frame step, the walls' motion and the statistics follow: gravity stays."""
    scale = radius_m / BASE_M
    root = scale**0.5
    shape = {"kind": "box", "size_m": [15 * radius_m] * 3, "center_m": [center_m] * 3}
    motion = {"kind": "oscillation", "axis": [0, 0, 1], "amplitude_m": radius_m, "frequency_hz": 5 / root}
    part = {"shape": shape, "points": 300, "friction_angle_rad": 0.5, "motion": motion}
    base = scenes.scene(40, 5, 0.01 * root, boundary={"walls": part}, damping=0.2)
    made = replace(base, grains=replace(base.grains, radius_m=radius_m))
    model = simulator(made, dtype=dtype)
    correction = [0.1 * root, 0.2 * root, 10.0 / root]
    own = {
        "velocity_m_s": STATISTICS["velocity_m_s"] * root,
        "spin_rad_s": STATISTICS["spin_rad_s"] / root,
        "radius_m": radius_m,
        "correction": correction,
    }
    model.statistics = replace(model.statistics, **own)
    model.scale = torch.tensor(correction, dtype=dtype).repeat_interleave(3)
    return model, scale, root


def state(scale: float, root: float, center_m: float = 0.0):
    base = state_in_box([40])
    return replace(
        base,
        pos=base.pos * scale + center_m,
        vel=base.vel * root,
        ang_vel=base.ang_vel / root,
        radius=base.radius * scale,
        time_s=base.time_s * root,
    )


@pytest.mark.parametrize("radius_m", [1e-5, 1.0])
def test_other_units(radius_m):
    (model, *_), (other, scale, root) = scaled(BASE_M), scaled(radius_m)
    other.load_state_dict({k: v for k, v in model.state_dict().items() if "boundary" not in k}, strict=False)
    before, there = state(1.0, 1.0), state(scale, root)
    after, again = model(before), other(there)
    assert model.graph(before).grain_edges.shape == other.graph(there).grain_edges.shape
    assert torch.allclose(again.pos / scale, after.pos, rtol=0, atol=1e-5 * BASE_M)
    assert torch.allclose(again.vel / root, after.vel, rtol=0, atol=1e-5 * 0.5)
    assert torch.allclose(again.ang_vel * root, after.ang_vel, rtol=0, atol=1e-5 * 20)


@pytest.mark.parametrize(("center_m", "within_m"), [(1.0, 1e-6), (1e3, 1e-6), (1e6, 1e-4)])
def test_far_from_the_origin_in_float32(center_m, within_m):
    (model, *_), (other, *_) = scaled(BASE_M, torch.float32), scaled(BASE_M, torch.float32, center_m)
    before, there = state(1.0, 1.0), state(1.0, 1.0, center_m)
    moved, again = model(before).pos - before.pos, other(there).pos - there.pos
    assert torch.allclose(moved, again, rtol=0, atol=within_m)

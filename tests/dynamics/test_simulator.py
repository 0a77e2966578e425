"""What every simulator must do, trained or not."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import read_window
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.errors import ConfigError, NumericalError
from gns_pyg.graph import neighbors
from tests import scenes
from tests.simulators import IMPULSE, MODEL, PAPER, simulator, state_in_box

SMALL_BOX = {"kind": "box", "size_m": [0.15, 0.15, 0.15], "center_m": [0.0, 0.0, 0.0]}


def boxed(n_grains, **motion):
    part = {"shape": SMALL_BOX, "points": 300, "friction_angle_rad": 0.5, "motion": motion or {"kind": "none"}}
    return scenes.scene(n_grains, 5, boundary={"walls": part})


TURNING = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 3.0}
every_model = pytest.mark.parametrize(
    "changes",
    [{}, {"state": "velocity"}, {"state": "differences", "skip": False}, PAPER, IMPULSE],
    ids=["full", "velocity", "differences", "paper", "impulse"],
)


def states_equal(a, b, **tolerance):
    return all(
        torch.allclose(x, y, **tolerance)
        for f in fields(a)
        if isinstance(x := getattr(a, f.name), torch.Tensor) and isinstance(y := getattr(b, f.name), torch.Tensor)
    )


@every_model
@pytest.mark.parametrize("motion", [{}, TURNING], ids=["still", "turning"])
def test_batch_equals_separate(changes, motion):
    model = simulator(boxed(60, **motion), dtype=torch.float64, **changes)
    together = state_in_box([25, 1, 34], spin=model.requires.state == "full")
    after = model(together)
    for graph in range(3):
        mine = together.batch == graph
        alone = model(pick(together, mine, graph))
        assert states_equal(pick(after, mine, graph), alone, rtol=1e-12, atol=1e-12)


def pick(state, mine, graph):
    spin = None if state.ang_vel is None else state.ang_vel[mine]
    return replace(
        state,
        pos=state.pos[mine],
        vel=state.vel[mine],
        ang_vel=spin,
        radius=state.radius[mine],
        time_s=state.time_s[graph : graph + 1],
        batch=torch.zeros(int(mine.sum()), dtype=torch.long),
    )


@every_model
def test_permuting_grains_permutes_the_result(changes):
    model = simulator(boxed(40), dtype=torch.float64, **changes)
    state = state_in_box([40], spin=model.requires.state == "full")
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    spin = None if state.ang_vel is None else state.ang_vel[order]
    shuffled = replace(state, pos=state.pos[order], vel=state.vel[order], ang_vel=spin)
    assert torch.allclose(model(shuffled).pos, model(state).pos[order], atol=1e-12)


def test_translation_without_absolute_position():
    shift = torch.tensor([3.0, -20.0, 7.0], dtype=torch.float64)
    scene = boxed(40)
    model, moved = (simulator(scene, dtype=torch.float64) for _ in range(2))
    moved.boundary.parts[0].pos += shift
    state = state_in_box([40])
    after = moved(replace(state, pos=state.pos + shift))
    assert torch.allclose(after.pos - shift, model(state).pos, atol=1e-10)


def test_absolute_position_does_break_translation():
    shift = torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)
    model, moved = (simulator(boxed(40), dtype=torch.float64, **PAPER) for _ in range(2))
    moved.boundary.parts[0].pos += shift
    state = state_in_box([40], spin=False)
    assert not torch.allclose(moved(replace(state, pos=state.pos + shift)).pos - shift, model(state).pos, atol=1e-6)


def test_a_grain_without_edges_flies_free_exactly():
    model = simulator(boxed(30))
    state = state_in_box([30])
    pos = state.pos.clone()
    pos[-1] = torch.tensor([5.0, 5.0, 5.0])
    state = replace(state, pos=pos)
    free = model.integrator.without_contact(state)
    assert torch.equal(model.correction(state)[-1], torch.zeros(9))
    assert torch.equal(model(state).pos[-1], free.pos[-1])


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_grains_and_no_edges(n):
    model, state = simulator(boxed(1)), state_in_box([n], half_m=1e-3)
    assert model(state).pos.shape == (n, 3)
    far = replace(state, pos=state.pos + torch.arange(10, 10 + n)[:, None])
    assert torch.equal(model(far).pos, model.integrator.without_contact(far).pos)


def test_a_scene_without_walls_has_no_wall_network():
    model = simulator(scenes.scene(20, 5, boundary={}))
    assert model.wall_network is None
    assert not any("wall" in key for key in model.state_dict())
    assert torch.isfinite(model(state_in_box([20])).pos).all()


def test_static_walls_are_indexed_once():
    model, built = simulator(boxed(20)), []
    original = neighbors.BACKENDS["kdtree"]

    def counting(points, batch):
        built.append(len(points))
        return original.build(points, batch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(neighbors.BACKENDS, "kdtree", replace(original, build=counting))
        list(rollout(model, state_in_box([20]), 5))
    assert built.count(300) == 1
    assert built.count(20) == 5


def test_turning_walls_are_searched_where_they_are():
    scene = boxed(20, **TURNING)
    model, state = simulator(scene, reachable_points=False, free_grains=False), state_in_box([12, 8], half_m=0.08)
    walls, edges = model.graph(state).walls, model.graph(state).wall_edges
    n_points = len(walls.pos) // 2
    near = (torch.cdist(walls.pos, state.pos) <= 0.03) & (
        torch.arange(2).repeat_interleave(n_points)[:, None] == state.batch[None]
    )
    expected = {tuple(pair) for pair in near.nonzero().tolist()}
    assert {tuple(pair) for pair in edges.T.tolist()} == expected
    speed = 2 * np.sin(3.0 * 0.01 / 2) / 0.01 * walls.pos[:n_points, 1:].norm(dim=1)  # the chord of a frame
    assert torch.allclose(walls.vel[:n_points].norm(dim=1), speed)


def test_oracle_replays_the_case_without_error(tmp_path):
    """A model that gives the true corrections rolls out with zero error."""
    random = np.random.default_rng(0)
    pos = np.cumsum(random.normal(0, 1e-3, (12, 20, 3)), axis=0)
    scene = scenes.scene(20, 12, damping=0.2)
    spin, vel = random.normal(0, 10, pos.shape), random.normal(0, 0.3, pos.shape)
    scenes.write_case(tmp_path / "case.h5", scene, pos, vel, spin)
    case = Trajectory(tmp_path / "case.h5")
    window = read_window(case, 0, 12)
    for kind in ("differences", "velocity", "full"):
        model = simulator(scene, state=kind, dtype=torch.float64)
        frames = iter(range(1, 11))

        def oracle(state, model=model, frames=frames):
            frame = next(frames)
            now, following = (model.integrator.read(window, f) for f in (frame, frame + 1))
            return model.target(now, following)

        model.correction = oracle
        for frame, state in enumerate(rollout(model, model.integrator.read(window, 1), 10), 2):
            assert torch.allclose(state.pos, window.pos[frame], atol=1e-12)


def test_rollout_names_step_field_and_grain_of_a_bad_value():
    def broken(state):
        vel = state.vel.clone()
        vel[3] = torch.nan
        return replace(state, vel=vel)

    with pytest.raises(NumericalError, match="(?s)step 1.*vel of grain 3"):
        list(rollout(broken, state_in_box([5]), 3))


@pytest.mark.parametrize(
    ("key", "value"), [("cutoff_grain_radii", 0.0), ("cutoff_wall_radii", -1.0), ("mlp_layers", 1)]
)
def test_impossible_models_are_refused(key, value):
    with pytest.raises(ConfigError, match=f"model.{key}"):
        simulator(boxed(1), **{**MODEL, key: value})


def test_gradients_of_coincident_grains_are_finite():
    model, state = simulator(boxed(4)), state_in_box([4])
    pos = state.pos[:1].expand(4, 3).clone().requires_grad_()
    model(replace(state, pos=pos)).pos.sum().backward()
    assert torch.isfinite(pos.grad).all()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)

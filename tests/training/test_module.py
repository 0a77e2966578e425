"""Noise, unrolling and schedule of the training module."""

from dataclasses import replace

import pytest
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import Windows
from gns_pyg.state import Window
from gns_pyg.training import loss as training_loss
from gns_pyg.training import module as training_module
from gns_pyg.training.config import TrainingConfig
from gns_pyg.training.module import TrainingModule
from gns_pyg.training.noise import perturb
from tests import scenes
from tests.simulators import simulator, state_in_box

CONFIG = dict(
    updates=60,
    batch_size=1,
    seed=0,
    lr_start=1e-4,
    halvings=5,
    noise_radii=0.1,
    noise_velocity=0.1,
    noise_in_walls=0.0,
    unroll=4,
    unroll_from=0.5,
    gradient_clip=0.0,
    loss_knee=0.0,
    balance=0.0,
    creep=0.0,
    creep_steps=4,
    gaps=0.0,
    average_decay=0.9,
)


def module():
    return TrainingModule(simulator(scenes.scene(20, 5)), TrainingConfig(**CONFIG))


def test_noise_is_added_to_a_copy():
    state, training = state_in_box([20]), module()
    before = state.pos.clone(), state.vel.clone(), state.ang_vel.clone()
    noisy, counted = perturb(state, training.config, training.simulator, [torch.Generator().manual_seed(0)])
    assert all(torch.equal(a, b) for a, b in zip(before, (state.pos, state.vel, state.ang_vel), strict=True))
    assert counted.all()
    assert (noisy.pos - state.pos).std().item() == pytest.approx(0.1 * 0.01, rel=0.3)
    assert (noisy.vel - state.vel).std().item() == pytest.approx(0.1 * 0.5, rel=0.3)


def test_that_share_of_the_grains_at_a_wall_starts_in_it():
    """Of 400 grains that lie on a floor and 400 above them."""
    box = {"kind": "box", "size_m": [0.8, 0.8, 0.8], "center_m": [0.0, 0.0, 0.4]}
    scene = scenes.scene(800, 5, boundary={"walls": {"shape": box, "points": 8000, "friction_angle_rad": 0.5}})
    rows = torch.cartesian_prod(torch.arange(-9.5, 10.0), torch.arange(-9.5, 10.0)).double() * 0.025
    lying, above = (torch.cat([rows, torch.full((400, 1), z).double()], dim=1) for z in (0.01, 0.03))
    state = replace(state_in_box([800]), pos=torch.cat([lying, above]))
    config = TrainingConfig(**CONFIG | {"noise_radii": 0.0, "noise_velocity": 0.0, "noise_in_walls": 0.25})
    model = simulator(scene)
    noisy, counted = perturb(state, config, model, [torch.Generator().manual_seed(0)])
    depth = (state.pos - noisy.pos) / 0.01
    moved = depth[:400, 2][depth[:400, 2] > 0]
    assert torch.equal(noisy.vel, state.vel)
    assert depth[:, :2].abs().max() == 0
    assert depth[400:].abs().max() == 0
    assert len(moved) / 400 == pytest.approx(0.25, abs=0.06)
    assert moved.mean().item() == pytest.approx(0.5, abs=0.1)
    assert moved.max() < 1
    apart = torch.cdist(state.pos, state.pos[:400][depth[:400, 2] > 0])
    beside = ((apart > 0) & (apart < model.cutoff_m)).any(1)
    assert 0 < beside.sum() < 800
    assert torch.equal(counted, ~beside)


def test_learning_rate_ends_at_the_paper_s_value():
    setup = module().configure_optimizers()
    optimizer, schedule = setup["optimizer"], setup["lr_scheduler"]["scheduler"]
    rates = []
    for _ in range(60):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[0] == pytest.approx(1e-4)
    assert rates[-1] == pytest.approx(3.125e-6)
    assert len(set(rates)) == 6


def test_unrolling_begins_when_told_and_takes_every_length(monkeypatch):
    training, drawn = module(), {0: [], 1: []}
    for update in range(60):
        monkeypatch.setattr(TrainingModule, "global_step", update)
        drawn[update >= 30] += [
            training._own_steps(torch.Generator().manual_seed(1000 * update + k)) for k in range(20)
        ]
    assert set(drawn[0]) == {0}
    assert set(drawn[1]) == {0, 1, 2, 3, 4}
    assert drawn[1].count(0) / len(drawn[1]) == pytest.approx(0.5, abs=0.08)


@pytest.mark.parametrize("state", ["differences", "velocity", "full"])
@pytest.mark.parametrize("own_steps", [0, 2])
@pytest.mark.parametrize("term", ["error", "balance", "creep", "gaps"])
def test_free_flight_leaves_nothing_to_learn(state, own_steps, term, tmp_path, monkeypatch):
    """Every step of every window, recorded or the model's own, is compared with the frame that it leads to."""
    scene = scenes.free_flight_case(tmp_path / "case.h5", n_frames=9, damping=0.2, rising=False)
    model = simulator(scene, state=state, dtype=torch.float64)
    monkeypatch.setattr(training_loss, "FEWEST", 1)
    monkeypatch.setattr(training_module, "CLASSES", (1e6,))  # all grains are slow,
    monkeypatch.setattr(training_module, "NEAR", 1e3)  # and all near
    weights = {"noise_radii": 0.0, "noise_velocity": 0.0} | ({} if term == "error" else {term: 1.0})
    training = TrainingModule(model, TrainingConfig(**CONFIG | weights))
    monkeypatch.setattr(training, "_own_steps", lambda random: own_steps)
    monkeypatch.setattr(training, "log", lambda *_, **__: None)
    windows = Windows([Trajectory(tmp_path / "case.h5")], 1 + training.config.window_length)
    batch = Window.collate([windows[0], windows[len(windows) - 1]])
    most = 1e-5 if term == "gaps" else 1e-8  # 0.1 um and 10 um/s of rounding in the file; a frame is 1
    assert training.training_step(batch, 0).item() < most


def test_gaps_are_those_of_pairs_that_are_near_at_the_start(tmp_path, monkeypatch):
    """Two of the grains nearly touch; where they go is what free flight says, until the record says otherwise."""
    scene = scenes.free_flight_case(tmp_path / "case.h5", n_frames=9, damping=0.2, rising=False)
    model = simulator(scene, dtype=torch.float64)
    monkeypatch.setattr(training_loss, "FEWEST", 1)
    training = TrainingModule(
        model, TrainingConfig(**CONFIG | {"noise_radii": 0.0, "noise_velocity": 0.0, "gaps": 1.0})
    )
    monkeypatch.setattr(training, "log", lambda *_, **__: None)
    windows = Windows([Trajectory(tmp_path / "case.h5")], 1 + training.config.window_length)
    window = Window.collate([windows[0]])
    pos, vel, radius = window.pos.clone(), window.vel.clone(), window.radius
    still = replace(window, vel=0 * vel, ang_vel=0 * window.ang_vel)
    away = torch.zeros(3, dtype=pos.dtype)
    away[0] = 2.01 * radius[0]
    pos[:, 1] = pos[:, 0] + away

    def loss(apart_m, gaps=1.0):
        training.config.gaps = gaps
        moved = pos.clone()
        moved[2:, 1, 0] += apart_m
        return training._ahead(replace(still, pos=moved), [torch.Generator()]).item()

    assert loss(1e-3) != pytest.approx(loss(0.0))
    assert loss(1e-3, gaps=2.0) == pytest.approx(2 * loss(1e-3))
    pos[:, 1, 0] += 0.1 * radius[0]  # too far to count
    assert loss(1e-3) == 0


def test_balance_adds_up_cells_of_every_size_each_with_its_weight(tmp_path, monkeypatch):
    scene = scenes.free_flight_case(tmp_path / "case.h5", n_frames=9)
    window = Windows([Trajectory(tmp_path / "case.h5")], 3)[0]

    def loss(*sizes, balance=2.0):
        monkeypatch.setattr(training_module, "CELLS", sizes)
        config = TrainingConfig(**CONFIG | {"balance": balance})
        training = TrainingModule(simulator(scene, dtype=torch.float64), config)
        monkeypatch.setattr(training, "log", lambda *_, **__: None)
        return training.training_step(window, 0).item()

    alone, large, small = loss(balance=0.0), (1e9, 3.0), (1e-6, 1.0)  # all grains in one cell; each in its own
    found = loss(large) - alone, loss(small) - alone
    assert min(found) > 0
    assert found[0] != pytest.approx(found[1])
    assert loss(small, large) - alone == pytest.approx(sum(found))
    assert loss((1e9, 6.0)) - alone == pytest.approx(2 * found[0])


def test_noise_is_seen_in_the_loss(tmp_path, monkeypatch):
    scene = scenes.free_flight_case(tmp_path / "case.h5", n_frames=9)
    training = TrainingModule(simulator(scene, dtype=torch.float64), TrainingConfig(**CONFIG))
    monkeypatch.setattr(training, "log", lambda *_, **__: None)
    window = Windows([Trajectory(tmp_path / "case.h5")], 1 + training.config.window_length)[0]
    assert training.training_step(window, 0).item() > 1e-3

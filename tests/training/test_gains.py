"""Training goes on from a bundle: with cases of several materials where it had seen one, or with fewer edges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gns_pyg import bundle
from gns_pyg.data.datamodule import Split
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.baselines import climatology
from gns_pyg.run import build
from gns_pyg.scene.requirements import Requires, resolve
from gns_pyg.scene.scene import PARAMETERS, Scene
from gns_pyg.training.config import TrainingConfig
from tests import scenes, simulators

FRICTIONS = (0.5, 0.2, 0.5)
TRAINING = dict(updates=1, batch_size=1, seed=0, lr_start=1e-3, halvings=0, noise_radii=0.0, noise_velocity=0.0)
TRAINING |= dict(
    noise_in_walls=0.0, unroll=0, unroll_from=0.0, gradient_clip=0.0, loss_knee=0.0, balance=0.0, creep=0.0
)
TRAINING |= dict(creep_steps=2, gaps=0.0, average_decay=0.0)


def cases(folder: Path) -> tuple[Scene, list[Trajectory]]:
    """A scene whose friction varies and a case of each of FRICTIONS; grains of case n stand n m above the origin."""
    scene = scenes.scene(2, 4, boundary={}, vary={"friction_angle_rad": list(FRICTIONS)})
    for case in range(len(FRICTIONS)):
        pos = np.tile([[0.0, 0.0, float(case)], [0.1, 0.0, float(case)]], (4, 1, 1))
        scenes.write_case(folder / f"case_{case:03d}.h5", scene.of_case(case), pos)
    return scene, [Trajectory(path) for path in sorted(folder.glob("*.h5"))]


def start(folder: Path, scene: Scene, network: str) -> str:
    """A bundle that has seen one material."""
    plain = simulators.simulator(replace(scene, vary={}), network=network)
    return str(bundle.save(folder / "one", plain, {"cases": {"train": {}, "val": {}, "test": {}}}))


def gained(folder: Path, network: str = "impulse"):
    scene, trajectories = cases(folder)
    config = TrainingConfig(**TRAINING, start_from=start(folder, scene, network))
    model = bundle.load(config.start_from).config
    requires = resolve(scene, {"friction_angle_rad": sorted(set(FRICTIONS))}, Requires())
    return build(scene, model, requires, Split(trajectories, [], [], []), config), bundle.load(config.start_from)


def test_a_parameter_that_begins_to_vary_changes_nothing_yet_and_can_be_learned(tmp_path) -> None:
    wide, before = gained(tmp_path)
    state = simulators.state_in_box([20, 20])
    values = [[1000.0, 1e6, 0.25, friction, 0.0] for friction in (0.2, 0.5)]
    told = replace(state, parameters=torch.tensor(values, dtype=torch.float64))
    assert torch.allclose(wide.correction(told), before.correction(state), atol=1e-6)
    wide.eval().correction(told).square().sum().backward()
    assert wide.encode_grain[0].weight.grad[:, -1].abs().max() > 0


def test_its_scale_is_that_of_the_cases_and_the_others_stay(tmp_path) -> None:
    wide, before = gained(tmp_path)
    friction = PARAMETERS.index("friction_angle_rad")
    assert wide.statistics.parameters_mean[friction] == pytest.approx(np.mean(FRICTIONS))
    assert wide.statistics.parameters_std[friction] == pytest.approx(np.std(FRICTIONS))
    assert wide.statistics.velocity_m_s == before.statistics.velocity_m_s


def test_message_networks_do_not_gain_parameters(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"material_features = \[\]"):
        gained(tmp_path, "message")


@pytest.mark.parametrize("asked", [{"touching_pairs": True}, {"nearest_points": True}])
def test_edges_may_be_left_out_from_here_on(tmp_path, asked: dict[str, bool]) -> None:
    scene, trajectories = cases(tmp_path)
    config = TrainingConfig(**TRAINING, start_from=start(tmp_path, scene, "impulse"))
    before = bundle.load(config.start_from)
    requires = replace(before.requires, **asked)
    after = build(scene, before.config, requires, Split(trajectories, [], [], []), config)
    assert after.requires == requires != before.requires
    assert all(torch.equal(value, before.state_dict()[name]) for name, value in after.state_dict().items())


def test_climatology_is_of_the_scenes_own_material_where_there_is_such_a_case(tmp_path) -> None:
    scene, trajectories = cases(tmp_path)
    assert climatology(trajectories, scene).center_of_mass_m[0, 2] == pytest.approx(1.0)  # of 0 and 2
    assert climatology(trajectories[1:2], scene).center_of_mass_m[0, 2] == pytest.approx(1.0)
    assert climatology(trajectories[:2], scene).center_of_mass_m[0, 2] == pytest.approx(0.0)

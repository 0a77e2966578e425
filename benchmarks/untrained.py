"""Recorded cases of a scene and untrained simulators of it: for what depends on no weights."""

from collections.abc import Callable
from typing import Any

from hydra import compose, initialize_config_dir

from gns_pyg import run
from gns_pyg.config import CONF, typed
from gns_pyg.data.coverage import values
from gns_pyg.data.datamodule import Split, find_cases, open_case
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.scene.requirements import Requires, resolve
from gns_pyg.scene.scene import Scene
from gns_pyg.training.config import TrainingConfig


def untrained(*overrides: str, first: int = 1) -> tuple[list[Trajectory], Callable[..., Simulator]]:
    """The `first` cases of a scene, and a function that builds a simulator of it; rows of what the scene requires are
    forced by its keywords. Overrides are train.py's."""
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("train", list(overrides))
    scene, model = Scene.from_config(config.scene), typed(ModelConfig, config.model, "model")
    training = typed(TrainingConfig, config.training, "training")
    cases = [open_case(path, scene) for path in find_cases(scene, config.data.dir)[:first]]

    def simulator(**forced: Any) -> Simulator:
        requires = resolve(scene, values(cases), Requires(**forced))
        return run.build(scene, model, requires, Split(cases, [], []), training).eval()

    return cases, simulator

"""The points of a trade-off: what is trained, what is only run otherwise, and which data all of it rests on."""

import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from gns_pyg.config import CONF, plain, require, typed
from gns_pyg.data.datamodule import DataConfig, Split, find_cases, split
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError
from gns_pyg.scene.scene import Scene

SWEEPS = Path(CONF) / "sweep"
NETWORKS = ("trained", "without_training", "shipped")
NAMES = {  # of the yardsticks
    "twins": "Yade, started a micrometre away",
    "seeds": "Yade, another seed",
    "climatology": "the training cases' mean curves",
    "frozen": "grains frozen at the start",
    "trivial": "best trivial single step",
}


@dataclass(frozen=True)
class Point:
    """One job and one row of the table.

    Attributes:
        kind: `trained`, `without_training` (a trained point, run otherwise), `shipped` (a bundle of the project),
            `yade`, or a yardstick: `twins`, `seeds`, `climatology`, `frozen`, `trivial`.
        training: overrides of train.py; for `shipped` the bundle's name, for `yade` the time step.
        running: overrides of evaluate.py.
    """

    kind: str
    training: tuple[str, ...]
    running: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        if self.kind in NAMES:
            return NAMES[self.kind]
        if self.kind == "shipped":
            return ", ".join([f"bundle={self.training[0]}", *self.running])
        if self.kind == "yade":
            return f"Yade, dt = {self.training[0]}" + (" s" if self.training[0] != "auto" else "")
        return (
            ", ".join([*(text for text in self.training if not text.startswith("data.dir")), *self.running])
            or "default"
        )


def points(cfg: DictConfig) -> list[Point]:
    """Every point of the config, no point twice: the sweeps', those without training, Yade's, the yardsticks.

    Raises:
        ConfigError: for a sweep that does not exist.
    """
    found = [Point("trained", training) for name in cfg.sweeps for training in sweep(name)]
    if cfg.shipped is not None:
        found.append(Point("shipped", (cfg.shipped,)))
    for entry in plain(cfg.without_training):
        kind, of = ("shipped", [cfg.shipped]) if entry["of"] == "shipped" else ("without_training", entry["of"])
        found.append(Point(kind, tuple(of), tuple(entry["with"])))
    found += [Point("yade", (str(step),)) for step in cfg.dem_steps_s]
    found += [Point(kind, ()) for kind in NAMES]
    defaults = ("model.hidden=64", "model.layers=3")  # of conf/model/contact.yaml: the default point is one point
    of_default = [p for p in found if p.kind == "trained" and p.training == defaults]
    return [Point("trained", ()) if p in of_default else p for p in dict.fromkeys(found)]


def sweep(name: str) -> list[tuple[str, ...]]:
    """The overrides of every job of conf/sweep/<name>.yaml, as `train.py -m sweep=<name>` runs them."""
    path = SWEEPS / f"{name}.yaml"
    known = ", ".join(sorted(file.stem for file in SWEEPS.glob("*.yaml")))
    require(path.is_file(), "sweeps", name, f"one of {known}", "add conf/sweep/NAME.yaml, or correct the name")
    params: Any = OmegaConf.to_container(OmegaConf.load(path).hydra.sweeper.params, resolve=False)
    axes = [[f"{key}={value}" for value in sweep_values(key, told)] for key, told in params.items()]
    return list(itertools.product(*axes))


def sweep_values(key: str, told: object) -> list[str]:
    """The values that Hydra would run through for `key=told`."""
    (override,) = OverridesParser.create().parse_overrides([f"{key}={told}"])
    return (
        list(override.sweep_string_iterator())
        if override.is_sweep_override()
        else [override.get_value_element_as_str()]
    )


def config(name: str, overrides: Sequence[str]) -> DictConfig:
    """The composed config of train.py or evaluate.py, inside a command that Hydra runs, too."""
    around = GlobalHydra.instance()
    outer, around.hydra = around.hydra, None
    try:
        with initialize_config_dir(CONF, version_base="1.3"):
            return compose(name, list(overrides))
    finally:
        GlobalHydra.instance().hydra = outer


def train_config(cfg: DictConfig, point: Point, *more: str) -> DictConfig:
    """The config that a point is trained with."""
    return config("train", [f"experiment={cfg.experiment}", *cfg.overrides, *point.training, *more])


def scene_of(cfg: DictConfig) -> Scene:
    """The scene that all points are judged in, at the frame step of its cases."""
    return Scene.from_config(train_config(cfg, Point("trained", ())).scene)


def cases_of(cfg: DictConfig) -> Split:
    """The cases that all points are judged on, `test`, and those that the default point is trained on."""
    training = train_config(cfg, Point("trained", ()), f"data.dir={cfg.data.dir or 'null'}")
    return split(scene_of(cfg), typed(DataConfig, training.data, "data"))


def digest(cfg: DictConfig, point: Point) -> str:
    """What a row depends on, as sixteen letters: its overrides, the budget, the data that it learns from and is judged
    on."""
    training = train_config(cfg, point if point.kind in ("trained", "without_training") else Point("trained", ()))
    scene = Scene.from_config(training.scene)
    told = asdict(point) | {
        "experiment": cfg.experiment,
        "overrides": list(cfg.overrides),
        "budget_cpu_s": cfg.budget_cpu_s,
        "judged": [cfg.start_s, cfg.compare_every_s],
        "learns_from": _hashes(scene, training.data.dir),
        "judged_on": _hashes(scene_of(cfg), cfg.data.dir),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def _hashes(scene: Scene, folder: str | None) -> list[str]:
    try:
        return [_hash(path, path.stat().st_mtime_ns) for path in find_cases(scene, folder)]
    except DataError:  # not there (yet): the job will say so
        return []


@cache
def _hash(path: Path, changed_ns: int) -> str:
    """Of the content of a file as it was changed last: every point of a table asks for the same few."""
    return Trajectory(path).content_hash()


def as_plain(point: Point) -> dict[str, Any]:
    """For a row."""
    return {"name": point.name, "kind": point.kind, "training": list(point.training), "running": list(point.running)}

"""Cases on disk -> training, validation and test."""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from torch.utils.data import ConcatDataset, DataLoader

from gns_pyg.config import flat, require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import Answers, UpdateSampler, Windows
from gns_pyg.errors import ConfigError, DataError
from gns_pyg.scene.containment import outside
from gns_pyg.scene.mesh import build_mesh, same_mesh
from gns_pyg.scene.scene import Scene
from gns_pyg.state import Window

EMBEDDED = Path(__file__).parents[2] / "data_gen" / "embedded"


@dataclass
class DataConfig:
    """Where the cases are and how they are split.

    Attributes:
        dir: folder of case_*.h5; None looks in $GNS_DATA/<scene> (default data/<scene>), then at the embedded cases.
        test_fraction: share of cases kept for testing, the last ones, rounded up.
        val_cases: cases kept for validation roll-outs during training.
        workers: data-loading processes beside the main one.
        answers: folders of answers_*.h5 to train on too (see `data_gen.answers`).
    """

    dir: str | None = None
    test_fraction: float = 0.2
    val_cases: int = 1
    workers: int = 0
    answers: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        require(0 <= self.test_fraction < 1, "data.test_fraction", self.test_fraction, "0 up to below 1", "e.g. 0.2")
        require(self.val_cases >= 0, "data.val_cases", self.val_cases, "at least 0", "e.g. 1; 0 validates on no case")
        require(self.workers >= 0, "data.workers", self.workers, "at least 0", "0 loads data in the main process")


@dataclass(frozen=True)
class Split:
    """Cases by purpose; no case serves two."""

    train: list[Trajectory]
    val: list[Trajectory]
    test: list[Trajectory]
    answers: list[Trajectory] = field(default_factory=list)  # to states of roll-outs of training cases

    def describe(self) -> dict[str, dict[str, str]]:
        """File name -> content hash, by purpose: what a bundle remembers of its data."""
        return {
            purpose: {t.path.name: t.content_hash() for t in getattr(self, purpose)}
            for purpose in ("train", "val", "test")
        } | {"answers": {f"{t.path.parent.name}/{t.path.name}": t.content_hash() for t in self.answers}}


def find_cases(scene: Scene, folder: str | None) -> list[Path]:
    """The scene's case files, in order.

    Raises:
        DataError: if there is none; says where it looked and how to generate them.
    """
    places = [Path(folder)] if folder is not None else _places(scene.name)
    if cases := _first_cases(places):
        return cases
    raise DataError(
        " and ".join(str(place) for place in places),
        "no case_*.h5",
        f"cases of the scene {scene.name}",
        f"generate them: python -m data_gen.generate -m scene={scene.name} 'case=range({scene.cases})', "
        "or name their folder: data.dir=...",
    )


def _places(name: str) -> list[Path]:
    return [Path(os.environ.get("GNS_DATA", "data")) / name, EMBEDDED / name]


def _first_cases(places: Sequence[Path]) -> list[Path]:
    return next((found for place in places if (found := sorted(place.glob("case_*.h5")))), [])


def open_case(path: str | Path, scene: Scene) -> Trajectory:
    """Opens a case and checks it.

    Where the scene's frame is a whole number of the recorded ones, that many are one step of the network. (Not with an
    inlet: when grains enter depends on the frame.)

    Raises:
        DataError: if it is damaged, of another scene, or starts with a grain outside the boundary.
    """
    trajectory = Trajectory(path)
    every = scene.frame_dt_s / max(trajectory.frame_dt_s, 1e-12)
    if scene.inlet is None and 1.5 < every < trajectory.n_frames and abs(every - round(every)) < 1e-6:
        trajectory = Trajectory(path, round(every))
    check_same_scene(trajectory, scene)
    check_inside(trajectory, scene)
    return trajectory


def open_to_compare(path: str | Path, scene: Scene, every_s: float | None = None) -> Trajectory:
    """Opens a case whose frames may lie further apart than the steps of a simulator of `scene`: what it did in
    between is not compared.

    Args:
        path: the case.
        scene: the simulator's.
        every_s: reads only the frames so many seconds apart; None: every recorded one that the simulator reaches.

    Raises:
        ConfigError: if `every_s` is no whole number of steps, or steps lie between frames of a scene with an inlet.
        DataError: see `open_case`.
    """
    wanted_s = max(scene.frame_dt_s, Trajectory(path).frame_dt_s) if every_s is None else every_s
    known = isinstance(wanted_s, int | float) and wanted_s > 0
    steps = wanted_s / scene.frame_dt_s if known else 0.0
    whole = known and round(steps) >= 1 and abs(steps - round(steps)) < 1e-6
    step = f"a whole number of the simulator's steps of {scene.frame_dt_s:g} s"
    require(whole, "compare_every_s", every_s or f"frames of {path} {wanted_s:g} s apart", step, "e.g. 0.01")
    found = f"{wanted_s:g} s in a scene with an inlet"
    require(scene.inlet is None or round(steps) == 1, "compare_every_s", found, "every step", "leave it null")
    return open_case(path, replace(scene, frame_dt_s=round(steps) * scene.frame_dt_s))


def open_condition(name: str, frame_dt_s: float) -> tuple[Scene, list[Trajectory]] | None:
    """The cases of a folder of that name in $GNS_DATA (or data/) or the embedded data, opened to be compared with a
    simulator of steps of `frame_dt_s`, and their scene, which is the first one's; None where there is no such
    folder."""
    paths = _first_cases(_places(name))
    if not paths:
        return None
    scene = replace(Scene.from_config(Trajectory(paths[0]).scene), frame_dt_s=frame_dt_s)
    return scene, [open_to_compare(path, scene) for path in paths]


def open_cases(scene: Scene, folder: str | None) -> list[Trajectory]:
    """Opens and checks all cases of a scene (see `find_cases`, `open_case`)."""
    return [open_case(path, scene) for path in find_cases(scene, folder)]


def split(scene: Scene, config: DataConfig) -> Split:
    """Opens, checks and splits the cases of a scene.

    Raises:
        DataError: if a case cannot be used (see `open_case`) or is there twice, or if too few are left to train on.
    """
    paths = find_cases(scene, config.dir)
    n_test = math.ceil(config.test_fraction * len(paths))
    n_train = len(paths) - n_test - config.val_cases
    if n_train < 1:
        raise DataError(
            paths[0].parent,
            f"{len(paths)} case(s), of which {n_test} for testing and {config.val_cases} for validation",
            "at least one left to train on",
            f"generate more (python -m data_gen.generate -m scene={scene.name} 'case=range({scene.cases})'), or lower "
            "data.test_fraction or data.val_cases",
        )
    trajectories = [open_case(path, scene) for path in paths]
    check_all_differ(trajectories)
    train = trajectories[:n_train]
    return Split(
        train,
        trajectories[n_train : n_train + config.val_cases],
        trajectories[-n_test:] if n_test else [],
        [file for folder in config.answers for file in open_answers(Path(folder), scene, train)],
    )


def check_all_differ(trajectories: Sequence[Trajectory]) -> None:
    """Checks that no run is there twice, so that none can serve two purposes.

    Raises:
        DataError: if two files hold the same positions; names both.
    """
    first: dict[str, Path] = {}
    for case in trajectories:
        twin = first.setdefault(case.content_hash(), case.path)
        if twin is not case.path:
            remedy = "delete one of them, or generate it with another case number"
            raise DataError(case.path, f"the same run as {twin.name}", "every run once", remedy)


def open_answers(folder: Path, scene: Scene, train: Sequence[Trajectory]) -> list[Trajectory]:
    """Opens and checks the answers (see `data_gen.answers`) in a folder.

    Raises:
        DataError: if there are none, or some are damaged, of another scene, or to roll-outs of no training case.
    """
    make = "make them: python -m data_gen.answers bundle=... out=..."
    if not (paths := sorted(folder.glob("answers_*.h5"))):
        raise DataError(folder, "no answers_*.h5", "answers of the DEM (data.answers)", make)
    files, known = [Trajectory(path) for path in paths], {case.content_hash() for case in train}
    for file in files:
        check_same_scene(file, scene, regular=False)
        if file.run.get("rolled_out_from") not in known:
            raise DataError(
                file.path, "answers to a roll-out of a case that is not trained on", "training cases only", make
            )
    return files


def check_same_scene(trajectory: Trajectory, scene: Scene, *, regular: bool = True) -> None:
    """Compares what a case says it was made from, and what it holds, with `scene`; unless `regular` is false, its
    frames must be the scene's frame step apart.

    Raises:
        DataError: if they differ; names every difference.
    """
    try:
        stored = Scene.from_config(trajectory.scene)  # keys that are newer than the file have their defaults
    except ConfigError as error:
        raise DataError(
            trajectory.path, f"a stored scene that cannot be read: {error}", "a scene", "generate the case again"
        ) from None
    ours, theirs = _physics(scene, scene.vary), _physics(stored, scene.vary)
    different = [
        f"{key} = {theirs.get(key)!r} (scene: {ours.get(key)!r})"
        for key in sorted(ours | theirs)
        if ours.get(key) != theirs.get(key)
    ] + _held_otherwise(trajectory, scene)
    if regular:
        different += _irregular(trajectory, scene)
    if different:
        raise DataError(
            trajectory.path,
            "; ".join(different),
            f"a case of the scene {scene.name} as configured",
            "choose the scene this file was made from, or generate the cases again",
        )


def check_inside(trajectory: Trajectory, scene: Scene) -> None:
    """Checks that every grain starts inside the boundary, those that enter later too.

    Raises:
        GeometryError: for a part made of a mesh file that is not closed: it has no inside.
        DataError: if grains are outside; names the first.
    """
    first = trajectory.read("position", 0, 1)
    there = trajectory.active(0, 1)[0]
    there[scene.grains.count - (scene.inlet.count if scene.inlet else 0) :] = True
    out = np.flatnonzero(outside(first, trajectory.times_s[:1], scene)[0] & there)
    if len(out):
        raise DataError(
            trajectory.path,
            f"{len(out)} grain(s) outside the boundary in the first frame, e.g. grain {out[0]} at {first[0, out[0]]} m",
            "every grain inside",
            "correct the scene's boundary, or generate the case again",
        )


def _held_otherwise(trajectory: Trajectory, scene: Scene) -> list[str]:
    """What a case holds that `scene` does not describe, whatever the case says of itself."""
    wrong: list[str] = []
    radii_m, count = np.array(scene.grains.radii_m), scene.grains.count
    if (odd := np.abs(trajectory.radius[:, None] / radii_m - 1).min(axis=1) > 1e-9).any():
        grain = int(odd.argmax())
        listed = " or ".join(f"{radius_m:g} m" for radius_m in radii_m)
        wrong.append(f"grain {grain} has a radius of {trajectory.radius[grain]:.9g} m (scene: {listed})")
    if trajectory.has_active != (passing := scene.outlet is not None or scene.inlet is not None):
        wrong.append(
            f"{'no ' if passing else ''}record of who is there (scene: {'an' if passing else 'no'} outlet or inlet)"
        )
    if trajectory.n_grains != count:
        wrong.append(f"{trajectory.n_grains} grains stored (scene: {count})")
    stored = trajectory.boundary
    for name in sorted(stored.keys() | scene.boundary.keys()):
        if name not in stored or name not in scene.boundary:
            wrong.append(f"boundary.{name}: a mesh {'in the scene' if name in scene.boundary else 'stored'} only")
        elif not same_mesh(stored[name], build_mesh(name, scene.boundary[name])):
            wrong.append(f"boundary.{name}: another mesh stored than the scene's")
    return wrong


def _irregular(trajectory: Trajectory, scene: Scene) -> list[str]:
    """Names the first frame that is not where the scene's frame step puts it."""
    dt_s, times_s = scene.frame_dt_s, trajectory.times_s - trajectory.times_s[0]
    off_s = np.abs(times_s - dt_s * np.arange(trajectory.n_frames))
    if (off_s <= 1e-6 * dt_s).all():
        return []
    frame = int((off_s > 1e-6 * dt_s).argmax())
    return [f"frame {frame} is {times_s[frame]:g} s after the first (scene: {frame * dt_s:g} s)"]


def _physics(scene: Scene, varying: Iterable[str]) -> dict[str, Any]:
    """The part of a scene that decides how grains move in all its cases, flattened to dotted keys."""
    decisive = ("gravity_m_s2", "damping", "damping_on_gravity", "frame_dt_s", "grains", "boundary", "outlet", "inlet")
    free = {name if name == "damping" else f"grains.material.{name}" for name in varying}
    leaves = flat({key: value for key, value in asdict(scene).items() if key in decisive})
    return {key: value for key, value in leaves.items() if not key.endswith(".points") and key not in free}


class DataModule(pl.LightningDataModule):
    """Training windows of the training cases. Validation and test are roll-outs; see the callbacks and `run`.

    Args:
        cases: the split.
        length: frames of a window.
        batch_size: windows per update, over all processes.
        seed: of the shuffling.
        workers: data-loading processes.
    """

    def __init__(self, cases: Split, *, length: int, batch_size: int, seed: int, workers: int) -> None:
        super().__init__()
        self.cases, self.batch_size, self.seed, self.workers = cases, batch_size, seed, workers
        recorded, answers = Windows(cases.train, length), Answers(cases.answers)
        times = max(1, round(len(recorded) / len(answers))) if len(answers) else 0  # about half of all
        self.windows: ConcatDataset = ConcatDataset([recorded, *[answers] * times])

    def train_dataloader(self) -> DataLoader:
        done, process, processes = 0, 0, 1
        if self.trainer:
            done, process, processes = self.trainer.global_step, self.trainer.global_rank, self.trainer.world_size
        return DataLoader(
            self.windows,
            batch_sampler=UpdateSampler(len(self.windows), self.batch_size, self.seed, done, process, processes),
            collate_fn=_collate,
            num_workers=self.workers,
        )


def _collate(windows: Sequence[Window]) -> Window:
    return Window.collate(list(windows))

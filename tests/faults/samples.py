"""One sound, tiny file of every kind that is read from outside, and what opening each of them means."""

import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gns_pyg import bundle, run
from gns_pyg.config import CONF, plain
from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.errors import ConfigError
from gns_pyg.evaluation.baselines import Climatology
from gns_pyg.evaluation.predict import start_frame
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from tests import scenes
from tests.simulators import state_in_box

N_GRAINS, N_FRAMES = 5, 20
SHAPE = {"kind": "box", "size_m": [0.4, 0.4, 0.4]}
MOTION = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "function": "0.5 * t**2"}
OVERRIDES = [
    *("model.hidden=4", "model.layers=1", "model.cutoff_wall_radii=8", "training.batch_size=2", "training.unroll=2"),
    *("training.unroll_from=0", "training.updates=12", "callbacks.checkpoint.every_n_train_steps=3", "start_s=0.02"),
    *("callbacks.rollout_metrics=null", "data.test_fraction=0", "data.val_cases=0", "model.mlp_layers=2"),
]


def tiny_scene() -> Scene:
    part = {"shape": SHAPE, "points": 300, "friction_angle_rad": 0.5, "motion": MOTION}
    tiny = scenes.scene(N_GRAINS, N_FRAMES, boundary={"walls": part})
    tiny.gravity_m_s2 = [0.0, 0.0, 0.0]
    return tiny


def write_cases(folder: Path, n: int = 3) -> Scene:
    """Cases of grains that fly apart, bounce (the velocities turn round) and spin; writes them and the scene's YAML."""
    scene = tiny_scene()
    for case in range(n):
        random = np.random.default_rng(case)
        pos, vel = random.uniform(-0.03, 0.03, (N_GRAINS, 3)), random.normal(0, 0.2, (N_GRAINS, 3))
        swing = np.abs((np.arange(N_FRAMES) + 10) % 20 - 10)[:, None, None] * scene.frame_dt_s
        sign = np.where(np.arange(N_FRAMES) < 10, 1.0, -1.0)[:, None, None]
        spin = random.normal(0, 5, (N_FRAMES, N_GRAINS, 3))
        scenes.write_case(folder / f"case_{case:03d}.h5", scene, pos + vel * swing, vel * sign, spin)
    (folder / "scene.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(asdict(scene))))
    return scene


def config(name: str, folder: Path, scene: Path | None, *overrides: str) -> DictConfig:
    """An entry point's config for the tiny scene."""
    with initialize_config_dir(CONF, version_base="1.3"):
        cfg = compose(name, [f"folder={folder}", *overrides])
    if scene is not None:
        OmegaConf.set_struct(cfg, False)
        cfg.scene = OmegaConf.load(scene)
        OmegaConf.set_struct(cfg, True)
    return cfg


def train(data: Path, folder: Path, *overrides: str) -> dict[str, Any]:
    return run.train(config("train", folder, data / "scene.yaml", *OVERRIDES, f"data.dir={data}", *overrides))


def write_samples(folder: Path) -> None:
    """A sound sample of every kind, each under its name in OPEN, and the data that the checkpoint belongs to."""
    (folder / "data").mkdir(parents=True)
    scene = write_cases(folder / "data")
    train(folder / "data", folder / "run", "training.updates=9")
    (folder / "trajectory.h5").write_bytes((folder / "data" / "case_000.h5").read_bytes())
    (folder / "scene.yaml").write_bytes((folder / "data" / "scene.yaml").read_bytes())
    (folder / "checkpoint.ckpt").write_bytes((folder / "run" / "checkpoints" / "last.ckpt").read_bytes())
    shutil.copytree(folder / "run" / "bundle", folder / "bundle")
    build_mesh("walls", scene.boundary["walls"]).export(folder / "mesh.stl")


def open_trajectory(path: Path, data: Path) -> None:
    """Opens a case and reads all of it: what it gives must be finite and of the shapes it says."""
    case = Trajectory(path)
    for field in ("position", "velocity"):
        values = case.read(field)
        assert values.shape == (case.n_frames, case.n_grains, 3), values.shape
        assert np.isfinite(values).all(), field
    assert case.active().shape == (case.n_frames, case.n_grains)
    for part in case.boundary.values():
        assert np.isfinite(part["vertices"][part["triangles"]]).all()
    assert len(case.content_hash()) == 16


def open_bundle(path: Path, data: Path) -> None:
    """Does what rollout.py and evaluate.py do with a bundle, for one step."""
    loaded, card = bundle.load(path), bundle.card(path)
    run.unseen_cases(loaded.scene, str(data), card, None)
    case = open_to_compare(data / "case_000.h5", loaded.scene)
    run.warn_outside(loaded.scene, case, start_frame(case, 0.02), card)
    expected = Climatology.from_plain(card["climatology"])
    assert expected.center_of_mass_at(case.times_s).shape == (N_FRAMES, 3)
    assert isinstance(expected.mean_angle_of_repose_deg(loaded.scene), float)
    state = state_in_box([N_GRAINS], spin=loaded.requires.state == "full")
    (after,) = rollout(loaded, state, 1)
    assert after.pos.shape == state.pos.shape


def open_checkpoint(path: Path, data: Path) -> None:
    """Resumes from a checkpoint of 9 updates and trains on to 12."""
    train(data, path.parent / "run", f"ckpt_path={path}")
    weights = bundle.load(path.parent / "run" / "bundle").state_dict()
    assert all(torch.isfinite(value).all() for value in weights.values())


def open_scene(path: Path, data: Path) -> None:
    """Reads a scene as `scene=...` does and builds its meshes."""
    try:
        values = OmegaConf.load(path)
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, OSError) as error:  # Hydra says it before we are called
        raise ConfigError(path, str(error), "YAML", "correct it") from None
    scene = Scene.from_config(values)
    for name, part in scene.boundary.items():
        assert np.isfinite(build_mesh(name, part).vertices).all()
    assert plain(scene)


def open_mesh(path: Path, data: Path) -> None:
    """Builds a boundary part of a mesh file."""
    part = tiny_scene().boundary["walls"]
    part.shape = {"kind": "file", "path": str(path)}
    mesh = build_mesh("walls", part)
    assert isinstance(mesh, trimesh.Trimesh)
    assert np.isfinite(mesh.vertices).all()
    assert len(mesh.faces)


OPEN: dict[str, Callable[[Path, Path], None]] = {
    "trajectory.h5": open_trajectory,
    "bundle": open_bundle,
    "checkpoint.ckpt": open_checkpoint,
    "scene.yaml": open_scene,
    "mesh.stl": open_mesh,
}

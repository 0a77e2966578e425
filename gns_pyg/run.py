"""What the entry points call: each takes the composed config and returns its metrics."""

import itertools
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from hydra.errors import CompactHydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from gns_pyg import bundle
from gns_pyg.config import plain, require, typed
from gns_pyg.data.datamodule import DataConfig, DataModule, Split, check_same_scene, split
from gns_pyg.data.statistics import measure
from gns_pyg.data.trajectory import Trajectory, TrajectoryWriter
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.rollout import rollout as rollout_states
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import GnsError
from gns_pyg.evaluation.baselines import FIRST_FRAME, climatology
from gns_pyg.evaluation.metrics import Evaluation, case_result, evaluate_cases, strict, write_json
from gns_pyg.evaluation.predict import initial_state, one_step_errors, roll_out, start_frame
from gns_pyg.report.page import write_page
from gns_pyg.report.plots import write_plots
from gns_pyg.report.table import metrics_table
from gns_pyg.scene.boundary_points import sample_boundary_points
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from gns_pyg.training.config import TrainingConfig
from gns_pyg.training.module import TrainingModule

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> dict[str, Any]:
    """Trains a simulator on a scene's cases, evaluates it on the unseen ones and saves it as a bundle.

    Returns:
        The metrics that are also written to metrics.json in the run folder.
    """
    folder, where = Path(cfg.folder), device(cfg)
    scene = Scene.from_config(cfg.scene)
    training = typed(TrainingConfig, cfg.training, "training")
    data = typed(DataConfig, cfg.data, "data")
    cases = split(scene, data)
    log.info(
        "%s: %d cases to train on, %d for validation, %d unseen", scene.name, *(len(c) for c in vars(cases).values())
    )
    simulator = build(scene, typed(ModelConfig, cfg.model, "model"), cases, training.seed)
    log.info("model: %d parameters", sum(p.numel() for p in simulator.parameters()))
    datamodule = DataModule(
        cases,
        length=training.window_length,
        batch_size=training.batch_size,
        seed=training.seed,
        workers=data.workers,
    )
    quiet_lightning()
    trainer = pl.Trainer(
        **plain(cfg.trainer),
        accelerator=where.type,
        max_steps=training.updates,
        gradient_clip_val=training.gradient_clip or None,
        logger=instantiate(cfg.logger),
        callbacks=[instantiate(callback) for callback in cfg.callbacks.values() if callback is not None],
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=50,
    )
    trainer.fit(TrainingModule(simulator, training), datamodule, ckpt_path=cfg.ckpt_path, weights_only=True)
    trainer.save_checkpoint(folder / "checkpoints" / "last.ckpt")
    return _judge(simulator.eval().to(where), cases, cfg, folder)


def build(scene: Scene, config: ModelConfig, cases: Split, seed: int) -> Simulator:
    """A new simulator for a scene, its scales measured on the training cases, its weights drawn from `seed`."""
    statistics = measure(cases.train, Integrator(scene, config.state, residual=config.residual))
    points = {
        name: sample_boundary_points(build_mesh(name, part), part.points, scene.seed)
        for name, part in scene.boundary.items()
    }
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Simulator(scene, config, points, statistics)


def quiet_lightning() -> None:
    """Lightning's remarks on the machine and its own deprecations are no help to our users."""
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    logging.getLogger("pytorch_lightning.utilities.rank_zero").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Evaluates a bundle on the unseen cases of its scene (or on data.dir)."""
    simulator = load_bundle(cfg)
    return _judge(simulator, split(simulator.scene, typed(DataConfig, cfg.data, "data")), cfg, Path(cfg.folder))


def rollout(cfg: DictConfig) -> dict[str, Any]:
    """Rolls a bundle out from a recorded case and writes the trajectory in the data's own format."""
    simulator, folder = load_bundle(cfg), Path(cfg.folder)
    require(cfg.trajectory is not None, "trajectory", "null", "a case file", "e.g. trajectory=data/hopper/case_016.h5")
    trajectory = Trajectory(cfg.trajectory)
    check_same_scene(trajectory, simulator.scene)
    start = start_frame(trajectory, cfg.start_s)
    return write_rollout(simulator, trajectory, start, folder / "rollout.h5")


def load_bundle(cfg: DictConfig) -> Simulator:
    """The bundle that `bundle=PATH` names."""
    require(
        cfg.bundle is not None, "bundle", "null", "a bundle folder", "bundle=runs/.../bundle, as train.py prints it"
    )
    return bundle.load(cfg.bundle).to(device(cfg))


def device(cfg: DictConfig) -> torch.device:
    """Where to compute: `device` of the config, `auto` being the GPU where there is one."""
    known = ("auto", "cpu", "cuda")
    require(cfg.device in known, "device", cfg.device, " or ".join(known), "pick one of them")
    cuda = torch.cuda.is_available()
    require(cuda or cfg.device != "cuda", "device", "cuda, but torch finds no GPU", "a GPU", "set device=cpu")
    return torch.device("cuda" if cuda and cfg.device != "cpu" else "cpu")


def write_rollout(simulator: Simulator, trajectory: Trajectory, start: int, path: Path) -> dict[str, Any]:
    """Rolls out from the recorded frame `start` and writes every frame to `path`, in the data's own schema."""
    scene = simulator.scene
    state = initial_state(simulator, trajectory, start).to(simulator.scale.device)
    fields = (
        scene.dem.decimals
        if state.ang_vel is not None
        else {key: scene.dem.decimals[key] for key in ("position", "velocity")}
    )
    n_steps = trajectory.n_frames - 1 - start
    begin = time.perf_counter()
    with TrajectoryWriter(
        path, asdict(scene), trajectory.radius, trajectory.mass, trajectory.boundary, fields
    ) as writer:
        for step, now in enumerate(itertools.chain([state], rollout_states(simulator, state, n_steps))):
            now = now.to("cpu")
            spin = None if now.ang_vel is None else now.ang_vel.numpy()
            writer.append(step, float(now.time_s[0]), now.pos.numpy(), now.vel.numpy(), spin)
        wall_clock_s = time.perf_counter() - begin
        writer.finish(
            {
                "wall_clock_s": wall_clock_s,
                "cores": torch.get_num_threads(),
                "steps": n_steps,
                "dt_s": scene.frame_dt_s,
                "creator": "gns_pyg",
                "creator_version": version("gns_pyg"),
                "case": trajectory.path.name,
            }
        )
    log.info("%d steps in %.2f s -> %s", n_steps, wall_clock_s, path)
    return {"rollout": str(path), "speed/seconds_per_simulated_second": wall_clock_s / (n_steps * scene.frame_dt_s)}


def judge(simulator: Simulator, cases: Split, start_s: float) -> Evaluation | None:
    """Rolls the unseen cases out and compares them with DEM; None where there is no unseen case."""
    if not cases.test:
        return None
    results = []
    for case in cases.test:
        start = start_frame(case, start_s)
        pos, seconds = roll_out(simulator, case, start)
        results.append(
            case_result(case, simulator.scene, pos, start, one_step_errors(simulator, case), FIRST_FRAME, seconds)
        )
    return evaluate_cases(results, climatology(cases.train, simulator.scene), simulator.scene)


def versions(case: Trajectory) -> dict[str, str]:
    """Programs that had a part in the result."""
    packages = ("gns_pyg", "torch", "torch_geometric", "pytorch_lightning", "numpy", "scipy")
    return {name: version(name) for name in packages} | {case.run["creator"]: case.run["creator_version"]}


def entry(function: Callable[[DictConfig], dict[str, Any]]) -> Callable[[DictConfig], dict[str, Any]]:
    """Makes an entry point end with a message and status 1, no traceback, on an error that a user can act on."""

    @wraps(function)
    def run(cfg: DictConfig) -> dict[str, Any]:
        try:
            return function(cfg)
        except GnsError as error:
            raise CompactHydraException(f"{type(error).__name__}: {error}") from None  # printed without a traceback

    return run


def _judge(simulator: Simulator, cases: Split, cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Evaluates, draws, prints, and writes metrics.json, the report and (after training) the bundle."""
    scene, places = simulator.scene, {"run folder": folder}
    evaluation = judge(simulator, cases, cfg.start_s)
    metrics = evaluation.metrics if evaluation else {}
    if "model" in cfg:
        card = {"cases": cases.describe(), "training": plain(cfg.training), "metrics": metrics}
        places["bundle"] = bundle.save(folder / "bundle", simulator, strict(card))
    write_json(folder / "metrics.json", metrics)
    if evaluation is None:
        log.info("no unseen case, so nothing to judge the model by (data.test_fraction=0)")
        return metrics
    figures = write_plots(evaluation, scene, folder / "plots")
    places |= {"plots": folder / "plots", "report": folder / "report.html"}
    title = f"{scene.name}: {len(cases.test)} unseen cases from {cfg.start_s:g} s on"
    config = OmegaConf.to_yaml(cfg, resolve=True)
    write_page(folder / "report.html", title, metrics, figures, scene, config, versions(cases.test[0]))
    log.info("\n%s", metrics_table(metrics, title, places))
    return metrics

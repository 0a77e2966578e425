"""What the entry points call: each takes the composed config and returns its metrics."""

import itertools
import logging
import warnings
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import Timer
from pytorch_lightning.utilities.exceptions import MisconfigurationException
from pytorch_lightning.utilities.rank_zero import rank_zero_only
from torch import nn

from gns_pyg import bundle, machine
from gns_pyg.config import check_keys, flat, plain, require, typed
from gns_pyg.data.coverage import coverage, outside_coverage, seen, starts, values
from gns_pyg.data.datamodule import DataConfig, DataModule, Split, find_cases, open_to_compare, split
from gns_pyg.data.statistics import measure, scales_of_parameters
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.execution import Execution
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import CheckpointError, ConfigError, GnsError, NumericalError
from gns_pyg.evaluation.baselines import Climatology, climatology
from gns_pyg.evaluation.ensemble import Ensemble, roll_out_ensemble
from gns_pyg.evaluation.errors import positions
from gns_pyg.evaluation.judge import judge, judge_rollout
from gns_pyg.evaluation.metrics import Evaluation, dem_seconds, evaluate_cases, strict, write_json
from gns_pyg.evaluation.predict import start_frame, write_rollout
from gns_pyg.evaluation.stress import Bench, Line, run_lines
from gns_pyg.evaluation.stress_hard import HARD
from gns_pyg.evaluation.stress_measured import MEASURED
from gns_pyg.report.loggers import close, log_report
from gns_pyg.report.page import Model, read_stability, write_page
from gns_pyg.report.plots import ensemble_spread, write_figure, write_plots
from gns_pyg.report.table import ensemble_rows, metric_rows, text_table
from gns_pyg.report.verdict import draw_verdict, mark, verdict_table
from gns_pyg.scene.boundary_points import boundary_points
from gns_pyg.scene.requirements import Requirements, Requires, resolve
from gns_pyg.scene.scene import Scene
from gns_pyg.training import checkpoint
from gns_pyg.training.checkpoint import Checkpoints
from gns_pyg.training.config import TrainingConfig
from gns_pyg.training.module import TrainingModule

GROUPS = ["scene", "model", "requires", "data", "training", "trainer", "callbacks", "logger"]
MATERIAL, ENCODER = "requires.material_features", "encode_grain.0.weight"
MEMORY = ".from_drift."  # in the names of weights that look at it
TRAIN_KEYS = ["name", "start_s", "compare_every_s", "ckpt_path", "device", "folder", *GROUPS]
log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> dict[str, Any]:
    """Trains a simulator on a scene's cases, judges it on the unseen ones and saves it as a bundle.

    In a run folder that holds a checkpoint already, training goes on from it: the command that was killed, given again
    with the same run folder, ends as if it had not been.

    Returns:
        The metrics that are also written to metrics.json in the run folder.
    """
    folder, done = Path(cfg.folder), trained(cfg)
    if done is None:  # the first process judges and writes
        return {}
    simulator, cases, expected, card, trainer = done
    unseen = [open_to_compare(case.path, simulator.scene, cfg.compare_every_s) for case in cases.test]
    metrics = judge_and_report(simulator, unseen, expected, cfg, folder / "bundle", card, trainer)
    close(trainer.loggers)
    bundle.save(folder / "bundle", simulator, strict(card | {"metrics": metrics}))
    return metrics


def trained(cfg: DictConfig) -> tuple[Simulator, Split, Climatology, dict[str, Any], pl.Trainer] | None:
    """Trains and saves a bundle, unjudged.

    Returns:
        The simulator, the cases, the training cases' mean curves, the bundle's card and the trainer; None in all
        processes but the first.
    """
    check_keys(cfg, TRAIN_KEYS)
    folder, where = Path(cfg.folder), device(cfg)
    scene = Scene.from_config(cfg.scene)
    training = typed(TrainingConfig, cfg.training, "training")
    model = typed(ModelConfig, cfg.model, "model")
    data = typed(DataConfig, cfg.data, "data")
    forced = typed(Requires, cfg.requires, "requires")
    several = {f"training.{key}": getattr(training, key) for key in ("unroll", "creep", "gaps")}
    several["model.memory"] = model.memory
    for key, value in several.items():
        single = "0: answers are single frames, and tell what own steps would"
        require(not (data.answers and value), key, f"{value} with data.answers", single, f"set {key}=0")
    cases, before = split(scene, data), bundle.card(training.start_from) if training.start_from else {}
    if before:
        unseen = [case for case in cases.test if not seen(case, scene, before)]
        if left_out := len(cases.test) - len(unseen):
            log.warning("%d of %d test cases left out: training.start_from has seen them", left_out, len(cases.test))
        cases = replace(cases, test=unseen)
    requires = resolve(scene, values(cases.train), forced)
    log.info("what the scene requires (requires.<row> forces one):\n%s", requires)
    for case in (*cases.val, *cases.test):
        start_frame(case, cfg.start_s)
    log.info(
        "%s: %d cases to train on, %d for validation, %d unseen; %d files of answers",
        scene.name,
        *(len(c) for c in vars(cases).values()),
    )
    simulator = build(scene, model, requires, cases, training)
    datamodule = DataModule(
        cases,
        length=simulator.integrator.before() + training.window_length,
        batch_size=training.batch_size,
        seed=training.seed,
        workers=data.workers,
    )
    log.info("model: %d parameters", sum(p.numel() for p in simulator.parameters()))
    used = cases.describe()
    identity = flat({"model": asdict(model), "training": asdict(training), "cases": used})
    identity |= {f"requires.{row}": value for row, value in asdict(requires).items() if row != "reasons"}
    identity |= {f"scene.boundary.{name}.points": part.points for name, part in scene.boundary.items()}
    identity["scene.seed"] = scene.seed  # of the boundary points
    del identity["training.updates"]  # a run may be lengthened
    begun = {key: value.clone() for key, value in simulator.state_dict().items() if training.start_share}
    module = TrainingModule(simulator, training, identity)
    resume_from = cfg.ckpt_path
    if resume_from is None and (last := folder / "checkpoints" / "last.ckpt").is_file():
        log.info("going on from %s", last)
        resume_from = str(last)
    set_log_aside(folder)
    timer = Timer()  # its time is part of a checkpoint: a resumed run goes on counting
    trainer = build_trainer(cfg, training, where, timer)
    fit(trainer, module, datamodule, resume_from)
    trainer.save_checkpoint(folder / "checkpoints" / "last.ckpt")
    if not trainer.is_global_zero:
        return None
    simulator = module.judged.eval().to(where)
    if training.start_share:
        with torch.no_grad():
            for name, weights in simulator.named_parameters():
                weights.lerp_(begun[name].to(where), training.start_share)
    expected = climatology(cases.train, scene)
    card = {"cases": used, "training": plain(cfg.training), "climatology": asdict(expected)}
    card["cost"] = cost(cases, before, timer.time_elapsed("train"), where)
    card["coverage"] = coverage(scene, cases.train)
    card["starts"] = starts([*cases.train, *cases.val], scene, before.get("starts", []))
    bundle.save(folder / "bundle", simulator, strict(card))
    return simulator, cases, expected, card, trainer


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Judges a bundle on the cases of its scene (or of data.dir) that it was not trained or validated on.

    With `scene` that scene's cases are taken and simulated instead: transfer without training.
    """
    simulator, card = load_bundle(cfg), bundle.card(cfg.bundle)
    cases = unseen_cases(simulator.scene, cfg.data.dir, card, cfg.compare_every_s)
    for case in cases:
        warn_outside(simulator.scene, case, start_frame(case, cfg.start_s), card)
    return judge_and_report(simulator, cases, Climatology.from_plain(card["climatology"]), cfg, cfg.bundle, card)


def rollout(cfg: DictConfig) -> dict[str, Any]:
    """Rolls a bundle out from a recorded case, writes the trajectory in the data's own format, and compares it with the
    recorded case; with `ensemble`, so do as many copies of its start."""
    simulator, card = load_bundle(cfg), bundle.card(cfg.bundle)
    if cfg.trajectory is None:
        unseen = unseen_cases(simulator.scene, None, card, None)
        require(
            bool(unseen), "trajectory", "null, and no unseen case", "a case file", "trajectory=data/hopper/case_016.h5"
        )
        trajectory = unseen[0]
        log.info("from the unseen case %s", trajectory.path)
    else:
        trajectory = open_to_compare(cfg.trajectory, simulator.scene)
        if seen(trajectory, simulator.scene, card):
            log.warning("%s: the bundle was trained or validated on this case", trajectory.path.name)
    path, start = Path(cfg.folder) / "rollout.h5", start_frame(trajectory, cfg.start_s)
    warn_outside(simulator.scene, trajectory, start, card)
    ensemble = None if cfg.ensemble is None else roll_out_members(simulator, trajectory, start, cfg)
    seconds = write_rollout(simulator, trajectory, start, path)
    log.info("%.3g s per simulated second -> %s", seconds, path)
    result = judge_rollout(simulator, trajectory, start, positions(Trajectory(path)), seconds)
    evaluation = evaluate_cases([result], Climatology.from_plain(card["climatology"]), simulator.scene)
    done = report(simulator, [trajectory], evaluation, cfg, cfg.bundle, card, ensemble=ensemble)
    return {"rollout": str(path)} | done


def stress(cfg: DictConfig) -> dict[str, Any]:
    """Puts a bundle, or an untrained model, through the extremes; writes stability.json and a picture.

    Returns:
        `lines`: the verdict (see `evaluation.stress.Line`), as in stability.json.

    Raises:
        NumericalError: if a hard line does not hold; names them. Everything is written before.
    """
    folder, forms = Path(cfg.folder), ("full", "short")
    require(cfg.form in forms, "form", cfg.form, " or ".join(forms), "short is what the tests run")
    if cfg.bundle == "untrained":
        require(cfg.get("scene") is not None, "scene", None, "a scene", "e.g. scene=hopper_small")
        scene = Scene.from_config(cfg.scene)
        cases, training = split(scene, DataConfig(dir=cfg.data.dir)), typed(TrainingConfig, cfg.training, "training")
        requires = resolve(scene, values(cases.train), typed(Requires, cfg.requires, "requires"))
        simulator = build(scene, typed(ModelConfig, cfg.model, "model"), requires, cases, training).eval()
        case, covered = (cases.test or cases.train)[0], {}
    else:
        named, remedy = cfg.bundle is not None, "bundle=runs/.../bundle, as train.py prints it"
        require(named, "bundle", "null", "a bundle folder or untrained", remedy)
        simulator, card = bundle.load(cfg.bundle), bundle.card(cfg.bundle)
        unseen = unseen_cases(simulator.scene, cfg.data.dir, card, None)
        require(bool(unseen), "data.dir", cfg.data.dir, "a case that the bundle has not seen", "generate one more")
        case, covered = unseen[0], card["coverage"]
    bench = Bench(simulator, case, covered, cfg.form == "full", cfg.start_s)
    lines: list[Line] = []
    for registry, hard in ((HARD, True), (MEASURED, False)):
        for line in run_lines(bench, registry, hard, [str(text) for text in cfg.lines]):
            log.info("%s: %s (%.0f s)", line.line, mark(line), line.seconds)
            lines.append(line)
    found = {"bundle": str(cfg.bundle), "scene": simulator.scene.name, "form": cfg.form}
    found |= {"processor": machine.processor(), "lines": [line.plain() for line in lines], "curves": bench.curves}
    write_json(folder / "stability.json", found)
    title = f"{cfg.bundle}: {simulator.scene.name} at the extremes"
    places = {"run folder": folder}
    if (figure := draw_verdict(bench.curves, title)) is not None:
        write_figure(figure, folder / "plots" / "stability")
        places["picture"] = folder / "plots" / "stability.png"
    log.info("\n%s", verdict_table(lines, title, places))
    failed = [line.line for line in lines if line.holds is False]
    if failed:
        remedy = "see stability.json for what was found; docs/stability.md says what helps"
        raise NumericalError("hard lines", "; ".join(failed), "all of them hold", remedy)
    return found


def roll_out_members(simulator: Simulator, case: Trajectory, start: int, cfg: DictConfig) -> Ensemble:
    """Rolls out `ensemble` copies of a start; writes ensemble.json, prints the scores."""
    members = cfg.ensemble
    require(isinstance(members, int) and members >= 2, "ensemble", members, "at least 2 members", "e.g. ensemble=16")
    ensemble = roll_out_ensemble(simulator, case, start, members)
    write_json(Path(cfg.folder) / "ensemble.json", ensemble.plain())
    log.info("\n%s", text_table(f"{simulator.scene.name}, {case.path.stem}", ensemble_rows(ensemble), {}))
    return ensemble


def unseen_cases(scene: Scene, folder: str | None, card: dict[str, Any], every_s: float | None) -> list[Trajectory]:
    """The cases of a scene (see `open_to_compare`) that a bundle was neither trained nor validated on: neither their
    content nor, however they were recorded, their start is that of one that it was."""
    cases = [open_to_compare(path, scene, every_s) for path in find_cases(scene, folder)]
    return [case for case in cases if not seen(case, scene, card)]


def warn_outside(scene: Scene, case: Trajectory, start: int, card: dict[str, Any]) -> None:
    """Warns of everything about a case and its start that the bundle's training cases did not cover."""
    now = coverage(scene, [case], slice(start, start + 1))
    for text in outside_coverage(card["coverage"], now):
        log.warning("%s: outside what the bundle was trained on: %s", case.path.name, text)


def build(
    scene: Scene, config: ModelConfig, requires: Requirements, cases: Split, training: TrainingConfig
) -> Simulator:
    """A simulator for a scene: its scales measured on the training cases and its weights drawn from the seed, or both
    taken from the bundle `training.start_from`. If parameters vary here and none did there, or grains have a memory
    here alone, impulse networks gain them as inputs of weight zero: it predicts what the bundle does until it is
    trained.

    Raises:
        BundleError: if that bundle cannot be read.
        ConfigError: if its model or what it requires differs.
    """
    start = None if training.start_from is None else bundle.load(training.start_from)
    if start is not None:
        here, there = (
            flat({"model": asdict(m), "requires": asdict(r)})
            for m, r in ((config, requires), (start.config, start.requires))
        )
        # turned windows and left out edges are matters of training; networks do not know of them
        elsewhere = ("requires.reasons", "requires.symmetry", "requires.touching_pairs", "requires.nearest_points")
        differ = [key for key in sorted({*here, *there}) if here.get(key) != there.get(key)]
        can_gain = start.config.network == "impulse" and not start.requires.material_features
        gained = requires.material_features if can_gain else []
        more = {MATERIAL: gained, "model.memory": config.memory and not start.config.memory}
        keys = [key for key in differ if not key.startswith(elsewhere) and not more.get(key)]
        require(
            not keys,
            "training.start_from",
            "; ".join(f"{key} = {there.get(key)}" for key in keys),
            "; ".join(f"{key} = {here.get(key)}" for key in keys),
            "start from a bundle of this model",
        )
        statistics = start.statistics
        if gained:
            mean, std = scales_of_parameters(cases.train)
            statistics = replace(statistics, parameters_mean=mean, parameters_std=std)
    else:
        statistics = measure(cases.train, Integrator(scene, requires.state, free_flight=requires.free_flight))
    points = boundary_points(scene, config.cutoff_wall_radii)
    with torch.random.fork_rng():
        torch.manual_seed(training.seed)
        simulator = Simulator(scene, config, requires, points, statistics)
    if start is not None:
        networks = {key: value for key, value in start.state_dict().items() if not key.startswith("boundary.")}
        if gained:
            networks[ENCODER] = nn.functional.pad(networks[ENCODER], (0, len(gained)))  # its last inputs
        simulator.load_state_dict(networks, strict=False)
        if training.start_fixed:
            remedy = "set model.memory, or training.start_fixed=false"
            require(config.memory > 0, "training.start_fixed", "true, and nothing else to train", "a memory", remedy)
            for name, weights in simulator.named_parameters():
                weights.requires_grad_(MEMORY in name)
    return simulator


def build_trainer(cfg: DictConfig, training: TrainingConfig, where: torch.device, timer: Timer) -> pl.Trainer:
    """Lightning's trainer with the config's loggers and callbacks, and a timer.

    Raises:
        ConfigError: for keys or values under trainer, logger or callbacks that cannot be built.
    """
    for name in ("pytorch_lightning", "pytorch_lightning.utilities.rank_zero"):  # remarks on the machine
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*exists and is not empty.*")  # a run that goes on
    try:
        trainer = pl.Trainer(
            **plain(cfg.trainer),
            accelerator=where.type,
            max_steps=training.updates,
            gradient_clip_val=training.gradient_clip or None,
            logger=instantiate(cfg.logger),
            callbacks=[timer, *(instantiate(callback) for callback in cfg.callbacks.values() if callback is not None)],
            default_root_dir=cfg.folder,
            plugins=[Checkpoints()],
            use_distributed_sampler=False,  # UpdateSampler divides batches itself
            enable_progress_bar=False,
            enable_model_summary=False,
            log_every_n_steps=50,
        )
    except (TypeError, ValueError, InstantiationException, MisconfigurationException) as error:
        raise ConfigError(
            "trainer, logger or callbacks",
            " ".join(str(error).split()),
            "keys and values of the classes that conf/trainer, conf/logger and conf/callbacks name",
            "correct or remove the key",
        ) from None
    for logger in trainer.loggers:
        logger.log_hyperparams(
            flat({key: plain(cfg[key]) for key in ("scene", "model", "requires", "training", "data")})
        )
    return trainer


def fit(trainer: pl.Trainer, module: TrainingModule, datamodule: DataModule, ckpt_path: str | None) -> None:
    """Trains, from `ckpt_path` on where it is given.

    Raises:
        ConfigError: if there is no such checkpoint, or it is of another config or other data.
        CheckpointError: if it is damaged.
    """
    if ckpt_path is not None:
        known = "a checkpoint of this model, e.g. runs/.../checkpoints/last.ckpt"
        require(Path(ckpt_path).is_file(), "ckpt_path", f"{ckpt_path}: no such file", known, "correct the path")
    try:
        trainer.fit(module, datamodule, ckpt_path=ckpt_path, weights_only=True)
    except (GnsError, OSError):
        raise
    except Exception as error:  # whatever else Lightning trips over before the first update is in the checkpoint
        if ckpt_path is None or module.started:
            raise
        found = f"{type(error).__name__}: {error}"
        raise CheckpointError(ckpt_path, found, "a checkpoint written by train.py", checkpoint.REMEDY) from None


@rank_zero_only
def set_log_aside(folder: Path) -> None:
    """Renames the log of an earlier start in this folder to log_0, log_1, ...: Lightning would delete its rows."""
    if (folder / "log").is_dir():
        number = next(n for n in itertools.count() if not (folder / f"log_{n}").exists())
        (folder / "log").rename(folder / f"log_{number}")


def load_bundle(cfg: DictConfig) -> Simulator:
    """The bundle that `bundle=PATH` names, for the scene that `scene` names if there is one."""
    require(
        cfg.bundle is not None, "bundle", "null", "a bundle folder", "bundle=runs/.../bundle, as train.py prints it"
    )
    execution, where = typed(Execution, cfg.execution, "execution"), device(cfg)
    execution.check(where)
    torch.set_float32_matmul_precision("high" if execution.precision == "tf32" else "highest")
    scene = Scene.from_config(cfg.scene) if cfg.get("scene") else None
    simulator = bundle.load(cfg.bundle, scene).to(where)
    if execution.precision == "float64":
        simulator = simulator.double()
    if (sweeps := cfg.get("projection_sweeps")) is not None:
        simulator.config = replace(simulator.config, projection_sweeps=sweeps)
    simulator.execution = execution
    return simulator


def device(cfg: DictConfig) -> torch.device:
    """Where to compute: `device` of the config, `auto` being the GPU where there is one."""
    known = ("auto", "cpu", "cuda")
    require(cfg.device in known, "device", cfg.device, " or ".join(known), "pick one of them")
    cuda = torch.cuda.is_available()
    require(cuda or cfg.device != "cuda", "device", "cuda, but torch finds no GPU", "a GPU", "set device=cpu")
    return torch.device("cuda" if cuda and cfg.device != "cpu" else "cpu")


def judge_and_report(
    simulator: Simulator,
    cases: list[Trajectory],
    expected: Climatology,
    cfg: DictConfig,
    bundle_name: str | Path,
    card: dict[str, Any],
    trainer: pl.Trainer | None = None,
) -> dict[str, Any]:
    """Judges a simulator on unseen cases and reports it; without a case, an empty metrics.json."""
    if not cases:
        log.info("no unseen case, so nothing to judge the model by")
        write_json(Path(cfg.folder) / "metrics.json", {})
        return {}
    return report(simulator, cases, judge(simulator, cases, expected, cfg.start_s), cfg, bundle_name, card, trainer)


def report(
    simulator: Simulator,
    cases: list[Trajectory],
    evaluation: Evaluation,
    cfg: DictConfig,
    bundle_name: str | Path,
    card: dict[str, Any],
    trainer: pl.Trainer | None = None,
    ensemble: Ensemble | None = None,
) -> dict[str, Any]:
    """Writes what a simulator did on `cases`: metrics.json, cases.json, plots and page; prints the table. The loggers
    of the trainer that trained it get the same."""
    folder, bundle_folder = Path(cfg.folder), bundle.find(bundle_name)
    scene = replace(simulator.scene, frame_dt_s=cases[0].frame_dt_s)  # of what is compared
    metrics = evaluation.metrics | {
        "speed/threads": torch.get_num_threads(),
        "speed/device": device_name(simulator.scale.device),
    }
    if ensemble is not None:
        metrics |= {f"crps/{name}": score for name, score in ensemble.crps().items()}
    write_json(folder / "metrics.json", metrics)
    write_json(folder / "cases.json", evaluation.per_case)
    figures = write_plots(evaluation, scene, folder / "plots")
    if ensemble is not None:
        apart = f"{scene.name}: {len(ensemble.error_m)} roll-outs that start a micrometre apart"
        figures += write_figure(ensemble_spread(ensemble, apart), folder / "plots" / "ensemble")
    if trainer is not None:
        log_report(trainer.loggers, evaluation, scene, figures, folder, trainer.global_step)
    unseen = not any(seen(case, simulator.scene, card) for case in cases)
    names = ", ".join(case.path.stem for case in cases)
    what = f"{names} ({'unseen' if unseen else 'which the model was trained or validated on'})"
    title = f"{scene.name}: {what} from {cfg.start_s:g} s on"
    model = Model(str(bundle_name), simulator.requires, card, read_stability(bundle_folder))
    page = folder / "report.html"
    config = OmegaConf.to_yaml(cfg, resolve=True)
    shown, used = evaluation.cases[0].result, versions(cases[0])
    write_page(page, title, metrics, figures, shown, scene, model, config, used, ensemble)
    places = {"run folder": folder, "bundle": bundle_folder, "plots": folder / "plots", "report": page}
    log.info("\n%s", text_table(title, metric_rows(metrics), places))
    return metrics


def cost(cases: Split, before: dict[str, Any], seconds: float, where: torch.device) -> dict[str, Any]:
    """What a bundle has cost: Yade for the cases of this training, s, and all training, wall s (None where the card
    `before`, of the bundle that it started from, does not say)."""
    earlier = before.get("cost", {"training_s": None})["training_s"] if before else 0.0
    learned = (*cases.train, *cases.val, *cases.answers)
    return {
        "dem_s": sum(dem_seconds(case.run) for case in learned),
        "training_s": None if earlier is None else earlier + seconds,
        "training_device": device_name(where),
    }


def device_name(where: torch.device) -> str:
    """The GPU's or processor's name."""
    return torch.cuda.get_device_name(where) if where.type == "cuda" else machine.processor()


def versions(case: Trajectory) -> dict[str, str]:
    """Programs that had a part in the result."""
    packages = ("gns_pyg", "torch", "torch_geometric", "pytorch_lightning", "numpy", "scipy")
    return {name: version(name) for name in packages} | {case.run["creator"]: case.run["creator_version"]}

"""The whole way through the house, in process, at a tiny size and on the embedded real data."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gns_pyg import bundle, run
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import EMBEDDED, DataConfig, split
from gns_pyg.data.trajectory import Trajectory, TrajectoryWriter
from gns_pyg.errors import BundleError, ConfigError, DataError, NumericalError
from gns_pyg.evaluation.metrics import dem_seconds, strict
from gns_pyg.evaluation.predict import initial_state
from gns_pyg.training import callbacks
from gns_pyg.training.module import TrainingModule
from tests.integration.runs import config, train

ROOT = Path(__file__).parents[2]
EXPERIMENTS = sorted(path.stem for path in (Path(CONF) / "experiment").glob("*.yaml"))


def weights(folder):
    return bundle.load(folder / "bundle").state_dict()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_and_takes_a_training_step(experiment, tmp_path):
    small = {"hopper": "hopper_small", "drum": "drum_small"}.get(name := experiment.removeprefix("paper_"), name)
    metrics = train(
        tmp_path, f"experiment={experiment}", f"scene={small}", "training.updates=1", "data.test_fraction=0"
    )
    assert metrics == {}
    assert (tmp_path / "bundle" / "weights.safetensors").is_file()


def test_metrics_are_written_with_units_and_strictly(trained):
    folder, metrics = trained
    stored = json.loads((folder / "metrics.json").read_text(), parse_constant=pytest.fail)
    for key in (
        "test/one_step_error_m",
        "test/one_step_error_trivial_m",
        "test/rollout_error_final_m",
        "test/rollout_error_final_frozen_m",
        "test/center_of_mass_error_max_m",
        "test/center_of_mass_error_climatology_max_m",
        "test/angle_of_repose_error_deg",
        "test/escaped_grains",
        "test/mean_overlap_ratio",
        "test/mean_overlap_ratio_dem",
        "speed/seconds_per_simulated_second",
        "speed/yade_seconds_per_simulated_second",
    ):
        assert key in stored
    assert stored["test/one_step_error_m"] == metrics["test/one_step_error_m"]


def test_same_seed_same_weights(trained, tmp_path):
    train(tmp_path, "experiment=hopper", "training.updates=20", "training.unroll_from=0")
    one, two = weights(trained[0]), weights(tmp_path)
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_resuming_equals_one_shot(trained, tmp_path):
    overrides = ["experiment=hopper", "training.updates=20", "training.unroll_from=0"]

    class Stop(Exception):
        pass

    original = TrainingModule.training_step

    def interrupted(self, window, index):
        if self.global_step == 13:
            raise Stop
        return original(self, window, index)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingModule, "training_step", interrupted)
        with pytest.raises(Stop):
            train(tmp_path / "a", *overrides, "callbacks.checkpoint.every_n_train_steps=7")
    train(tmp_path / "b", *overrides, f"ckpt_path={tmp_path / 'a' / 'checkpoints' / 'last.ckpt'}")
    one, two = weights(trained[0]), weights(tmp_path / "b")
    assert all(torch.equal(one[key], two[key]) for key in one)
    stopped = torch.load(tmp_path / "a" / "checkpoints" / "last.ckpt", weights_only=True)
    before_s = stopped["callbacks"]["Timer"]["time_elapsed"]["train"]
    assert cost(tmp_path / "b")["training_s"] > before_s > 0, "time goes on counting"


def cost(folder):
    return bundle.describe(folder / "bundle")["card"]["cost"]


def test_the_card_says_what_the_model_has_cost(trained):
    cases = bundle.describe(trained[0] / "bundle")["card"]["cases"]
    learned = [Trajectory(EMBEDDED / "hopper_small" / name) for use in ("train", "val") for name in cases[use]]
    assert len(learned) == 6
    assert cost(trained[0])["dem_s"] == pytest.approx(sum(dem_seconds(case.run) for case in learned))
    assert cost(trained[0])["training_s"] > 0


def test_a_bundle_that_goes_on_from_another_costs_both(trained, tmp_path):
    start = f"training.start_from={trained[0] / 'bundle'}"
    train(tmp_path / "a", "experiment=hopper", "training.updates=1", start)
    assert cost(tmp_path / "a")["training_s"] > cost(trained[0])["training_s"]
    shutil.copytree(trained[0] / "bundle", tmp_path / "old")
    description = json.loads((tmp_path / "old" / "bundle.json").read_text())
    del description["card"]["cost"]
    (tmp_path / "old" / "bundle.json").write_text(json.dumps(description))
    train(tmp_path / "b", "experiment=hopper", "training.updates=1", f"training.start_from={tmp_path / 'old'}")
    assert cost(tmp_path / "b")["training_s"] is None


def test_a_share_of_the_old_weights_stays(trained, tmp_path):
    start = ["experiment=hopper", "training.updates=2", f"training.start_from={trained[0] / 'bundle'}"]
    train(tmp_path / "new", *start)
    train(tmp_path / "kept", *start, "training.start_share=0.25")
    old, new, kept = (weights(folder) for folder in (trained[0], tmp_path / "new", tmp_path / "kept"))
    assert any(not torch.equal(old[key], new[key]) for key in old)
    for key in old:
        torch.testing.assert_close(kept[key], 0.25 * old[key] + 0.75 * new[key], rtol=1e-5, atol=1e-7)
    with pytest.raises(ConfigError, match=r"training\.start_share"):
        train(tmp_path / "none", "experiment=hopper", "training.start_share=0.5")


def test_creep_is_part_of_the_loss_and_asks_for_frames(tmp_path):
    overrides = ["experiment=hopper", "training.updates=2", "training.unroll=0", "data.test_fraction=0"]
    train(tmp_path / "one", *overrides)
    train(tmp_path / "two", *overrides, "training.creep=1", "training.creep_steps=3")
    train(tmp_path / "gaps", *overrides, "training.creep=1", "training.creep_steps=3", "training.gaps=1")
    one, two, gaps = (weights(tmp_path / name) for name in ("one", "two", "gaps"))
    assert any(not torch.equal(one[key], two[key]) for key in one)
    assert any(not torch.equal(two[key], gaps[key]) for key in two)
    with pytest.raises(DataError, match="creep_steps"):
        train(tmp_path / "long", *overrides, "training.creep=1", "training.creep_steps=500")
    for key in ("creep", "gaps"):
        with pytest.raises(ConfigError, match=rf"training\.{key}"):
            train(tmp_path / "answers", *overrides, f"training.{key}=1", "data.answers=[somewhere]")


def test_a_memory_is_learned_beside_what_stays(trained, tmp_path):
    start = f"training.start_from={trained[0] / 'bundle'}"
    recall = ["experiment=hopper", "training.updates=3", start, "model.memory=2", "data.test_fraction=0"]
    recall += ["training.unroll=0", "training.creep=1", "training.creep_steps=2", "training.average_decay=0"]
    train(tmp_path / "fixed", *recall, "training.start_fixed=true")
    train(tmp_path / "all", *recall)
    old, fixed, new = (weights(folder) for folder in (trained[0], tmp_path / "fixed", tmp_path / "all"))
    assert all(torch.equal(fixed[key], old[key]) for key in old)
    assert any(not torch.equal(new[key], old[key]) for key in old)
    gained = fixed.keys() - old.keys()
    assert gained
    assert all(".from_drift." in key and fixed[key].any() for key in gained)
    with pytest.raises(ConfigError, match=r"training\.start_fixed"):
        train(tmp_path / "none", "experiment=hopper", start, "training.start_fixed=true")
    with pytest.raises(ConfigError, match=r"training\.start_fixed"):
        train(tmp_path / "new", "experiment=hopper", "training.start_fixed=true")
    with pytest.raises(ConfigError, match=r"model\.memory"):
        train(tmp_path / "answers", *recall, "training.creep=0", "data.answers=[somewhere]")


def test_bundle_equals_checkpoint(trained):
    """The bundle holds the averaged weights of the last checkpoint."""
    checkpoint = torch.load(trained[0] / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    stored, prefix = weights(trained[0]), "average.module."
    averaged = {key.removeprefix(prefix): value for key, value in checkpoint.items() if key.startswith(prefix)}
    assert averaged.keys() == stored.keys()
    assert all(torch.equal(averaged[key], stored[key]) for key in stored)
    assert any(not torch.equal(checkpoint[f"simulator.{key}"], stored[key]) for key in stored)


def test_bundle_predicts_what_the_trained_model_predicts(trained, tmp_path):
    simulator = bundle.load(trained[0] / "bundle")
    case = split(simulator.scene, DataConfig()).test[0]
    state = initial_state(simulator, case, 10)
    bundle.save(tmp_path / "copy", simulator, {})
    assert torch.equal(bundle.load(tmp_path / "copy")(state).pos, simulator(state).pos)


def test_evaluating_the_bundle_gives_the_training_s_metrics(trained, tmp_path):
    folder, metrics = trained
    again = run.evaluate(config(tmp_path, f"bundle={folder / 'bundle'}", "start_s=1.15", name="evaluate"))
    same = [key for key in metrics if not key.startswith("speed/")]
    assert strict([again[key] for key in same]) == strict([metrics[key] for key in same])


def test_rollout_is_a_valid_trajectory(trained, tmp_path):
    folder, _ = trained
    case = EMBEDDED / "hopper_small" / "case_007.h5"
    run.rollout(config(tmp_path, f"bundle={folder / 'bundle'}", f"trajectory={case.resolve()}", name="rollout"))
    written, dem = Trajectory(tmp_path / "rollout.h5"), Trajectory(case)
    assert written.n_frames == dem.n_frames - 10
    assert np.abs(written.read("position", 0, 1) - dem.read("position", 10, 11)).max() < 1e-5
    assert written.times_s[0] == pytest.approx(0.1)


def test_training_never_changes_the_data(tmp_path, monkeypatch):
    """Noise and unrolling of a few updates leave the file and the window that was handed out as they were."""
    held, case = [], EMBEDDED / "hopper_small" / "case_000.h5"
    before, original = case.read_bytes(), TrainingModule.training_step

    def keeping(self, window, index):
        copy = window.pos.clone(), window.vel.clone(), window.ang_vel.clone()
        loss = original(self, window, index)
        held.append(all(torch.equal(a, b) for a, b in zip(copy, (window.pos, window.vel, window.ang_vel), strict=True)))
        return loss

    monkeypatch.setattr(TrainingModule, "training_step", keeping)
    noise = ["training.noise_radii=0.5", "training.noise_velocity=0.5", "training.unroll_from=0"]
    train(tmp_path, "experiment=hopper", "training.updates=6", "data.test_fraction=0", *noise)
    assert held == [True] * 6
    assert case.read_bytes() == before


def test_evaluation_leaves_out_what_was_trained_on(tmp_path):
    train(tmp_path / "a", "experiment=hopper", "training.updates=1", "data.test_fraction=0", "data.val_cases=0")
    assert run.evaluate(config(tmp_path / "b", f"bundle={tmp_path / 'a' / 'bundle'}", name="evaluate")) == {}


def test_a_checkpoint_of_another_config_is_refused_with_the_difference(trained, tmp_path):
    checkpoint = trained[0] / "checkpoints" / "last.ckpt"
    with pytest.raises(ConfigError, match="model.hidden = 8"):
        train(tmp_path, "experiment=hopper", f"ckpt_path={checkpoint}", "model.hidden=4")
    with pytest.raises(ConfigError, match="no such file"):
        train(tmp_path / "other", "experiment=hopper", "ckpt_path=nowhere.ckpt")


def test_a_run_can_be_lengthened(tmp_path):
    """20 updates, then on to 30, equal 30 in one go where the learning rate does not depend on the number."""
    overrides = ["experiment=hopper", "data.test_fraction=0", "training.halvings=0", "training.unroll_from=0"]
    train(tmp_path / "short", *overrides, "training.updates=4")
    checkpoint = tmp_path / "short" / "checkpoints" / "last.ckpt"
    train(tmp_path / "long", *overrides, "training.updates=8", f"ckpt_path={checkpoint}")
    train(tmp_path / "once", *overrides, "training.updates=8")
    one, two = weights(tmp_path / "long"), weights(tmp_path / "once")
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_a_diverging_validation_roll_out_is_a_figure_not_a_crash(tmp_path, monkeypatch):
    def diverge(*_):
        raise NumericalError("roll-out step 3", "nan", "finite values", "train longer")

    monkeypatch.setattr(callbacks, "roll_out", diverge)
    target = "{_target_: gns_pyg.training.callbacks.RolloutMetrics, every_n_updates: 2, start_s: 1.15}"
    often = [f"callbacks.rollout_metrics={target}", "data.val_cases=2"]
    train(tmp_path, "experiment=hopper", "training.updates=3", "data.test_fraction=0", *often)
    rows = [line for line in (tmp_path / "log" / "metrics.csv").read_text().splitlines() if "inf" in line]
    assert len(rows) == 2  # after updates 2 and 3


def command(*arguments):
    words = [sys.executable, *arguments]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


def test_a_sweep_runs_every_job(tmp_path):
    sweep = ["-m", "experiment=hopper", "model.hidden=4,8", "training.updates=1", "start_s=1.15"]
    done = command("train.py", *sweep, f"hydra.sweep.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    hidden = [json.loads((tmp_path / job / "bundle" / "bundle.json").read_text())["model"]["hidden"] for job in "01"]
    assert hidden == [4, 8]
    assert all((tmp_path / job / "metrics.json").is_file() for job in "01")


def test_the_command_line_ends_with_a_message_and_status_1(tmp_path):
    done = command("train.py", "experiment=hopper", "scene.grains.radius_m=-1", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 1
    assert "remedy" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_bundle_of_another_format_version_is_refused(trained, tmp_path):
    shutil.copytree(trained[0] / "bundle", tmp_path / "bundle")
    path = tmp_path / "bundle" / "bundle.json"
    path.write_text(path.read_text().replace(f'"format_version": {bundle.FORMAT_VERSION}', '"format_version": 99'))
    with pytest.raises(BundleError, match="format version 99"):
        bundle.load(tmp_path / "bundle")


def test_damaged_weights_are_refused(trained, tmp_path):
    shutil.copytree(trained[0] / "bundle", tmp_path / "bundle")
    path = tmp_path / "bundle" / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(BundleError, match="weights.safetensors"):
        bundle.load(tmp_path / "bundle")


def test_non_finite_loss_stops_with_the_update_named(tmp_path):
    with pytest.raises(NumericalError, match="training update"):
        train(
            tmp_path, "experiment=hopper", "training.updates=20", "training.lr_start=1e30", "training.gradient_clip=0"
        )


@pytest.mark.parametrize(
    ("override", "error", "match"),
    [
        ("scene.frame_dt_s=0", ConfigError, "scene.frame_dt_s"),
        ("scene.grains.radius_m=-0.01", ConfigError, "radius_m"),
        ("model.cutoff_grain_radii=0", ConfigError, "cutoff_grain_radii"),
        ("+model.hiden=3", ConfigError, "model.hiden"),
        ("+scene.gravty=3", ConfigError, "scene.gravty"),
        ("data.dir=/nowhere", DataError, "/nowhere"),
        ("scene.damping=0.5", DataError, "damping"),
        ("data.val_cases=9", DataError, "data.val_cases"),
        ("model.neighbors=octree", ConfigError, "octree"),
        ("data.val_cases=-1", ConfigError, "data.val_cases"),
        ("training.halvings=-1", ConfigError, "training.halvings"),
        ("training.unroll=-1", ConfigError, "training.unroll"),
        ("start_s=abc", ConfigError, "start_s"),
        ("start_s=99", DataError, "start_s"),
        ("+foo=3", ConfigError, "foo"),
        ("+trainer.presision=16", ConfigError, "presision"),
        ("+callbacks.checkpoint.evry=3", ConfigError, "evry"),
        ("device=tpu", ConfigError, "device"),
    ],
)
def test_bad_config_is_one_clear_error_and_leaves_no_output(override, error, match, tmp_path):
    with pytest.raises(error, match=match):
        train(tmp_path, "experiment=hopper", override)
    assert not (tmp_path / "metrics.json").exists()
    assert not (tmp_path / "bundle").exists()


def test_the_same_run_recorded_otherwise_is_not_unseen(trained, tmp_path):
    """A copy of a training case with fewer frames has another content, but the same start."""
    case = Trajectory(EMBEDDED / "hopper_small" / "case_000.h5")
    (tmp_path / "cases").mkdir()
    shape = [case.radius, case.mass, case.boundary, case.scene["dem"]["decimals"]]
    with TrajectoryWriter(tmp_path / "cases" / "case_000.h5", case.scene, *shape) as writer:
        for frame in range(case.n_frames - 1):
            fields = (case.read(name, frame, frame + 1)[0] for name in ("position", "velocity", "angular_velocity"))
            writer.append(frame, float(case.times_s[frame]), *fields)
        writer.finish(case.run)
    again = config(
        tmp_path / "run", f"bundle={trained[0] / 'bundle'}", f"data.dir={tmp_path / 'cases'}", name="evaluate"
    )
    assert run.evaluate(again) == {}

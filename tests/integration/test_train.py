"""The whole way through the house, in process, at a tiny size and on the embedded real data."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gns_pyg import bundle, run
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import EMBEDDED, DataConfig, split
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import BundleError, ConfigError, DataError, NumericalError
from gns_pyg.evaluation.predict import initial_state
from gns_pyg.scene.scene import Scene
from tests.integration.runs import config, train

EXPERIMENTS = sorted(path.stem for path in (Path(CONF) / "experiment").glob("*.yaml"))


def weights(folder):
    return bundle.load(folder / "bundle").state_dict()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_and_takes_a_training_step(experiment, tmp_path):
    small = {"hopper": "hopper_small", "drum": "drum_small"}[experiment.split("_")[-1]]
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

    from gns_pyg.training.module import TrainingModule

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


def test_bundle_equals_checkpoint(trained):
    folder, _ = trained
    checkpoint = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    stored = weights(folder)
    for key, value in checkpoint["state_dict"].items():
        name = key.removeprefix("simulator.")
        assert name not in stored or torch.equal(stored[name], value)


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
    assert [again[key] for key in same] == [metrics[key] for key in same]


def test_rollout_is_a_valid_trajectory(trained, tmp_path):
    folder, _ = trained
    case = EMBEDDED / "hopper_small" / "case_007.h5"
    run.rollout(config(tmp_path, f"bundle={folder / 'bundle'}", f"trajectory={case.resolve()}", name="rollout"))
    written, dem = Trajectory(tmp_path / "rollout.h5"), Trajectory(case)
    assert written.n_frames == dem.n_frames - 10
    assert np.abs(written.read("position", 0, 1) - dem.read("position", 10, 11)).max() < 1e-5
    assert written.times_s[0] == pytest.approx(0.1)


def test_training_never_changes_the_data():
    case = EMBEDDED / "hopper_small" / "case_000.h5"
    before = case.read_bytes()
    cases = split(Scene.from_config(config("/tmp", "experiment=hopper").scene), DataConfig())
    from gns_pyg.data.windows import Windows

    first = Windows(cases.train, 3)[5].pos.clone()
    second = Windows(cases.train, 3)[5].pos
    assert torch.equal(first, second)
    assert case.read_bytes() == before


def test_a_bundle_of_another_format_version_is_refused(trained, tmp_path):
    import shutil

    shutil.copytree(trained[0] / "bundle", tmp_path / "bundle")
    path = tmp_path / "bundle" / "bundle.json"
    path.write_text(path.read_text().replace('"format_version": 1', '"format_version": 99'))
    with pytest.raises(BundleError, match="format version 99"):
        bundle.load(tmp_path / "bundle")


def test_damaged_weights_are_refused(trained, tmp_path):
    import shutil

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
    ],
)
def test_bad_config_is_one_clear_error_and_leaves_no_output(override, error, match, tmp_path):
    with pytest.raises(error, match=match):
        train(tmp_path, "experiment=hopper", override)
    assert not (tmp_path / "metrics.json").exists()
    assert not (tmp_path / "bundle").exists()

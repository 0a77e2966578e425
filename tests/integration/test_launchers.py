"""Sweeps through the launchers; submitit's local executor stands for Slurm, its other executor."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from gns_pyg.config import CONF
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.files import held

ROOT = Path(__file__).parents[2]
SWEEP = ["-m", "experiment=hopper", "training.updates=1", "start_s=1.15", "callbacks.rollout_metrics=null"]


def command(*words):
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize(
    "launcher", [["joblib", "hydra.launcher.n_jobs=2"], ["submitit_local", "hydra.launcher.timeout_min=10"]]
)
def test_a_training_sweep_runs_every_job(launcher, tmp_path):
    command(
        "train.py",
        *SWEEP,
        "model.hidden=4,8",
        f"hydra/launcher={launcher[0]}",
        launcher[1],
        f"hydra.sweep.dir={tmp_path}",
    )
    hidden = [json.loads((tmp_path / job / "bundle" / "bundle.json").read_text())["model"]["hidden"] for job in "01"]
    assert hidden == [4, 8]
    assert all(json.loads((tmp_path / job / "metrics.json").read_text()) for job in "01")


@pytest.mark.yade
@pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)")
def test_cases_are_generated_by_submitit(tmp_path):
    words = [
        "-m",
        "scene=free",
        "scene.grains.count=20",
        "scene.duration_s=0.03",
        "case=0,1",
        f"out={tmp_path / 'cases'}",
    ]
    command("-m", "data_gen.generate", *words, "hydra/launcher=submitit_local", f"hydra.sweep.dir={tmp_path}")
    assert [Trajectory(tmp_path / "cases" / f"case_00{case}.h5").run["case"] for case in (0, 1)] == [0, 1]


@pytest.mark.parametrize("name", ["train", "generate"])
def test_slurm_is_a_choice_with_its_partition(name):
    slurm = ["hydra/launcher=submitit_slurm", "hydra.launcher.partition=cpu", "hydra.launcher.max_num_timeout=5"]
    with initialize_config_dir(CONF, version_base="1.3"):
        launcher = compose(name, slurm, return_hydra_config=True).hydra.launcher
    assert launcher._target_.endswith("SlurmLauncher")
    assert (launcher.partition, launcher.max_num_timeout) == ("cpu", 5)


def test_the_trainer_takes_lightning_s_keys_for_many_processes():
    with initialize_config_dir(CONF, version_base="1.3"):
        trainer = compose("train", ["trainer.devices=4", "trainer.num_nodes=2", "trainer.strategy=ddp"]).trainer
    assert (trainer.devices, trainer.num_nodes, trainer.strategy) == (4, 2, "ddp")


@pytest.mark.parametrize(
    ("variables", "says"),
    [({}, "in use"), ({"SLURM_PROCID": "1"}, "radius_m"), ({"RANK": "4", "LOCAL_RANK": "0"}, "radius_m")],
)
def test_processes_that_srun_or_torchrun_start_share_the_first_one_s_folder(variables, says, tmp_path):
    """The test holds the folder as the first process would; the config's error is what comes after the lock."""
    words = [sys.executable, "train.py", "scene.grains.radius_m=-1", f"hydra.run.dir={tmp_path}"]
    with held(tmp_path):
        done = subprocess.run(words, cwd=ROOT, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert says in done.stderr

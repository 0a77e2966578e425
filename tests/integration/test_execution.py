"""Precision, tiles, regions and throughput, through the entry points on the embedded real data."""

import csv

import pytest
import torch

from gns_pyg import machine, run
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError
from tests.integration.runs import config, train


def rolled_out(trained, folder, *overrides):
    case = "data_gen/embedded/hopper_small/case_000.h5"
    at = [f"bundle={trained[0] / 'bundle'}", f"trajectory={case}", "start_s=1.1"]
    run.rollout(config(folder, *at, *overrides, name="rollout"))
    path = Trajectory(folder / "rollout.h5")
    return torch.from_numpy(path.read("position", 0, path.n_frames))


def test_tiles_give_the_same_roll_out(trained, tmp_path):
    whole = rolled_out(trained, tmp_path / "a")
    tiled = rolled_out(trained, tmp_path / "b", "execution.tile_grains=60")
    torch.testing.assert_close(tiled[1], whole[1], rtol=0, atol=2e-7)  # a step; later ones part by rounding


@pytest.mark.skipif(not machine.has_bfloat16(), reason="the processor does not multiply bfloat16 itself")
def test_bfloat16_is_near_float32_and_not_it(trained, tmp_path):
    exact = rolled_out(trained, tmp_path / "a")
    rough = rolled_out(trained, tmp_path / "b", "execution.precision=bfloat16")
    moved = (exact[1] - exact[0]).norm(dim=1).mean()
    assert 0 < (rough[1] - exact[1]).norm(dim=1).mean() < 0.02 * moved


@pytest.mark.parametrize(
    ("override", "match"),
    [
        ("execution.precision=float8", "execution.precision"),
        ("execution.tile_grains=0", "execution.tile_grains"),
        ("+execution.tiles=3", "execution.tiles"),
        ("execution.precision=tf32", "execution.precision"),
        ("execution.capture=true", "execution.capture"),
        ("execution={precision: float32, tile_grains: 9, capture: true}", "one of the two"),
    ],
)
def test_what_a_device_cannot_do_is_refused(trained, tmp_path, override, match):
    with pytest.raises(ConfigError, match=match):
        rolled_out(trained, tmp_path, override, "device=cpu")


@pytest.mark.parametrize("overrides", [["training.region_grains=20"], ["trainer.precision=bf16-mixed"]])
def test_training_on_regions_and_in_mixed_precision(tmp_path, overrides):
    often = ["training.updates=4", "callbacks.throughput.every_n_updates=2", "data.test_fraction=0"]
    train(tmp_path, "experiment=hopper", *often, *overrides)
    rows = csv.DictReader((tmp_path / "log" / "metrics.csv").read_text().splitlines())
    rates = [float(row["train/edges_per_s"]) for row in rows if row["train/edges_per_s"]]
    assert len(rates) == 2
    assert min(rates) > 0

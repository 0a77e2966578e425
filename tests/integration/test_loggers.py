"""What the loggers hold after a training, without an account or a network."""

import csv
import json

import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.integration.runs import train

SHORT = ["experiment=hopper", "training.updates=2"]


def test_wandb_offline_holds_figures_table_plots_and_a_moving_picture_of_every_run(tmp_path, monkeypatch):
    """Two runs in one process, as in a sweep, are two runs of wandb."""
    monkeypatch.setenv("WANDB_SILENT", "true")
    for number in ("one", "two"):
        folder = tmp_path / number
        metrics = train(folder, *SHORT, "logger=wandb")
        (kept,) = (folder / "wandb").glob("offline-run-*/")
        (table,) = kept.glob("files/media/table/test/cases_*.json")
        stored = json.loads(table.read_text())
        assert [row[stored["columns"].index("case")] for row in stored["data"]] == ["case_006", "case_007"]
        assert len(list(kept.glob("files/media/images/test/plots_*.png"))) == len(list(folder.glob("plots/*.png")))
        (movie,) = kept.glob("files/media/videos/test/rollout_*.gif")
        with Image.open(movie) as frames:
            assert frames.n_frames >= 4
        summary = b"".join(path.read_bytes() for path in kept.glob("*.wandb"))
        assert all(key.encode() in summary for key in ("test/one_step_error_m", "speed/yade_dt_s"))
    assert metrics["test/escaped_grains"] >= 0


def test_tensorboard_holds_figures_table_and_plots(tmp_path):
    metrics = train(tmp_path, *SHORT, "logger=tensorboard")
    stored = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    (found,) = stored.Scalars("test/one_step_error_m")
    assert found.value == pytest.approx(metrics["test/one_step_error_m"])
    assert found.step == 2
    assert {f"test/{path.stem}" for path in tmp_path.glob("plots/*.png")} == set(stored.Tags()["images"])
    (text,) = stored.Tensors("test/cases/text_summary")
    assert b"case_006" in text.tensor_proto.string_val[0]


def test_csv_holds_figures_after_the_curves(tmp_path):
    metrics = train(tmp_path, *SHORT)
    with (tmp_path / "log" / "metrics.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["test/one_step_error_m"]) == pytest.approx(metrics["test/one_step_error_m"])
    assert int(last["step"]) == 2

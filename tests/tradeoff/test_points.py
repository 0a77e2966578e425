"""Points: what Hydra's own multirun would run, each once, known by what it rests on."""

import pytest
from omegaconf import OmegaConf

from gns_pyg.errors import ConfigError
from gns_pyg.scene.scene import Scene
from gns_pyg.tradeoff.points import SWEEPS, Point, digest, points, sweep, train_config
from tests.tradeoff.samples import config


def test_a_sweep_is_the_product_of_its_values():
    assert sweep("width_depth")[:3] == [
        ("model.hidden=16", "model.layers=1"),
        ("model.hidden=16", "model.layers=3"),
        ("model.hidden=32", "model.layers=1"),
    ]
    assert len(sweep("width_depth")) == 8


@pytest.mark.parametrize("name", sorted(path.stem for path in SWEEPS.glob("*.yaml")))
def test_every_sweep_composes_and_says_how_it_is_run(name, tmp_path):
    first = (SWEEPS / f"{name}.yaml").read_text().splitlines()[1]
    experiment = first.split("experiment=")[1]
    assert first.startswith(f"# python train.py -m sweep={name} experiment=")
    for training in sweep(name):
        cfg = train_config(config(tmp_path, f"experiment={experiment}"), Point("trained", training))
        Scene.from_config(cfg.scene)
        changed = {text.split("=")[0] for text in training}
        assert all(OmegaConf.select(cfg, key) is not None for key in changed)


@pytest.mark.parametrize("experiment", ["hopper", "drum"])
def test_no_point_is_there_twice_and_the_default_is_among_them(experiment, tmp_path):
    found = points(config(tmp_path, f"experiment={experiment}"))
    assert len(found) == len(set(found)) == len({point.name for point in found})
    assert Point("trained", ()) in found
    assert sum(point.kind == "trained" for point in found) >= 16


def test_a_row_is_known_by_overrides_budget_and_data(tmp_path):
    plain, point = config(tmp_path), Point("trained", ("model.hidden=8",))
    same = digest(config(tmp_path / "elsewhere"), point)
    assert digest(plain, point) == same
    others = [
        digest(plain, Point("trained", ("model.hidden=16",))),
        digest(config(tmp_path, "budget_cpu_s=1"), point),
        digest(config(tmp_path, 'overrides=["training.seed=3"]'), point),
        digest(config(tmp_path, "data.dir=nowhere"), point),
        digest(config(tmp_path, "experiment=drum"), point),
    ]
    assert len({same, *others}) == 6


def test_an_unknown_sweep_is_named_with_those_there_are(tmp_path):
    with pytest.raises(ConfigError, match="width_depth"):
        points(config(tmp_path, "sweeps=[depht]"))

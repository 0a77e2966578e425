"""The page of all config keys: current, and complete against what Hydra composes."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from gns_pyg.config import CONF, flat
from gns_pyg.configuration import configuration_page

DOCS = Path(__file__).parents[1] / "docs"
PAGE = configuration_page()
ROWS = [[cell.strip() for cell in line.split(" | ")] for line in PAGE.splitlines() if line.startswith("| `")]
APPS = sorted(path.stem for path in Path(CONF).glob("*.yaml"))


def test_the_committed_page_is_what_the_code_writes():
    """python -m gns_pyg.configuration writes it anew."""
    assert (DOCS / "configuration.md").read_text(encoding="utf-8") == PAGE


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_every_key_has_a_default_and_a_meaning(row):
    assert row[1]
    assert row[-1].rstrip("| ")


@pytest.mark.parametrize("app", APPS)
def test_every_key_of_the_composed_config_is_on_the_page(app):
    keys = {row[0].removeprefix("| ").strip("`") for row in ROWS}
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = compose(app)
    for key in flat(OmegaConf.to_container(composed, resolve=False)):
        parts = key.split(".")
        if parts[:2] == ["scene", "boundary"]:
            parts[2] = "<part>"
        ways = {".".join(parts[:length]) for length in range(1, len(parts) + 1)}
        assert ways & keys, key


def test_what_stands_in_angle_brackets_is_shown():
    assert "runs go to runs/&lt;name>/&lt;time>" in PAGE
    assert "### scene.boundary.&lt;part>.motion" in PAGE
    assert "`scene.boundary.<part>.motion.kind`" in PAGE


def test_units_follow_from_the_keys():
    units = {row[0].removeprefix("| ").strip("`"): row[-2] for row in ROWS}
    assert units["scene.frame_dt_s"] == "s"
    assert units["scene.gravity_m_s2"] == "m/s²"
    assert units["scene.boundary.<part>.motion.rate_rad_s"] == "rad/s"
    assert units["scene.boundary.<part>.motion.speed_m_s"] == "m/s"
    assert units["scene.inlet.rate_per_s"] == "1/s"
    assert units["scene.grains.material.density_kg_m3"] == "kg/m³"
    assert units["model.hidden"] == ""


def test_a_changed_default_changes_the_page(monkeypatch):
    from gns_pyg.dynamics.model_config import ModelConfig

    monkeypatch.setattr(ModelConfig.__dataclass_fields__["projection_sweeps"], "default", 3)
    monkeypatch.setattr("gns_pyg.configuration._values", lambda path: {})
    assert "| `model.projection_sweeps` | `3` | `3` |" in configuration_page()

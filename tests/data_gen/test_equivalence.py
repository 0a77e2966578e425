"""Comparing cases at two time steps, on embedded cases that stand for both."""

import json
import shutil
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from data_gen.equivalence import equivalence
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import EMBEDDED
from gns_pyg.errors import ConfigError


def compared(folder: Path, reference: dict[int, int], cases: int = 3) -> dict:
    """Embedded cases, compared with others under their names: {name: case}."""
    for place, names in (("data", {n: n for n in range(cases)}), ("reference", reference)):
        (folder / place).mkdir(parents=True)
        for name, case in names.items():
            shutil.copy(EMBEDDED / "hopper_small" / f"case_{case:03d}.h5", folder / place / f"case_{name:03d}.h5")
    with initialize_config_dir(CONF, version_base="1.3"):
        places = [f"data.dir={folder}/data", f"reference={folder}/reference", f"folder={folder}"]
        return equivalence(compose("equivalence", ["scene=hopper_small", *places]))


def test_a_run_differs_from_itself_in_nothing_and_the_scatter_is_that_of_the_cases(tmp_path):
    result = compared(tmp_path, {0: 0})
    rows = {**result["values"], **result["distances"]}
    assert {"center_of_mass_m", "discharge_rate_kg_s", "angle_of_repose_deg", "mean_speed_m_s"} <= rows.keys()
    for row in rows.values():
        assert row["difference"] == row["largest"] == 0.0
        assert row["scatter"] > 0
    assert json.loads((tmp_path / "equivalence.json").read_text())["pairs"] == ["case_000.h5"]


def test_another_run_differs_as_much_as_cases_do(tmp_path):
    result = compared(tmp_path, {0: 1, 1: 0})
    speed = result["values"]["mean_speed_m_s"]
    assert speed["difference"] == pytest.approx(0.0, abs=1e-12)  # one more, the other less
    assert speed["largest"] > 0
    assert (
        0.3
        < result["distances"]["center_of_mass_m"]["largest"] / result["distances"]["center_of_mass_m"]["scatter"]
        < 3
    )


def test_what_cannot_be_compared_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="at least 3"):
        compared(tmp_path / "few", {0: 0}, cases=2)
    with pytest.raises(ConfigError, match="reference"):
        compared(tmp_path / "others", {7: 7})

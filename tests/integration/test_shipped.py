"""The bundles that ship with the project, by name."""

import json

import numpy as np
import pytest

from gns_pyg import bundle, run
from gns_pyg.data.datamodule import EMBEDDED
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import BundleError, ConfigError
from gns_pyg.evaluation.errors import position_error, positions
from gns_pyg.models.impulse_network import Damping
from tests.integration.runs import config

SHIPPED = sorted(path.name for path in bundle.SHIPPED.iterdir())


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_bundle_rolls_out_from_an_unseen_case_and_stays_near_it(name, tmp_path):
    scene, card = bundle.load(name).scene, bundle.card(name)
    used = [f"bundle={name}", f"start_s={scene.duration_s - 0.2:g}"]
    metrics = run.rollout(config(tmp_path, *used, name="rollout"))
    written = Trajectory(tmp_path / "rollout.h5")
    dem = Trajectory(EMBEDDED / scene.name / written.run["start_from"])
    assert dem.path.name in card["cases"]["test"]
    error = position_error(positions(written), positions(dem, dem.n_frames - written.n_frames))
    near = np.isclose(written.times_s - written.times_s[0], 0.1)
    assert error[near] < 0.01, "0.1 s of it: half a radius"
    assert (
        json.loads((tmp_path / "metrics.json").read_text())["test/one_step_error_m"] == metrics["test/one_step_error_m"]
    )
    assert f"{dem.path.stem} (unseen)" in (tmp_path / "report.html").read_text()


def test_a_bundle_of_before_contacts_were_damped_along_axes_damps_none():
    last = bundle.load("hopper").damping.shares[-1]
    assert not last.weight[Damping.FELT].any()
    assert not last.bias[Damping.FELT].any()


def test_an_ensemble_says_mean_spread_and_score(tmp_path):
    scores = run.rollout(config(tmp_path, "bundle=hopper", "start_s=1.15", "ensemble=3", name="rollout"))
    stored = json.loads((tmp_path / "ensemble.json").read_text(), parse_constant=pytest.fail)
    assert stored["members"] == 3
    assert len(stored["times_s"]) == 6
    speed = stored["observables"]["mean_speed_m_s"]
    assert np.allclose(speed["mean"], speed["dem"], rtol=0.5, atol=0.05)
    assert scores["crps/mean_speed_m_s"] == stored["crps"]["mean_speed_m_s"] >= 0
    page = (tmp_path / "report.html").read_text()
    assert "3 roll-outs from starts 1 \N{MICRO SIGN}m apart" in page
    assert '<figure class="ensemble">' in page
    assert Trajectory(tmp_path / "rollout.h5").n_frames == 6


def test_what_cannot_be_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="ensemble"):
        run.rollout(config(tmp_path, "bundle=hopper", "ensemble=1", name="rollout"))
    with pytest.raises(BundleError, match="no_such"):
        run.rollout(config(tmp_path, "bundle=no_such", name="rollout"))

"""Restarts from parts of stored frames, and twins: three grains on real Yade, whose answers are known by hand."""

import json
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data_gen import continuation, dem
from data_gen.dem import run_dem
from data_gen.initial import Start
from data_gen.restart import STATES, partial_state, restart, sufficient, table
from data_gen.twins import twins
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import EMBEDDED
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics import integrator
from gns_pyg.errors import ConfigError, DataError, DependencyError
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene

FEW = ["scene=hopper_small", "scene.grains.count=3", "scene.dem.dt_s=1e-4"]
needs_yade = [
    pytest.mark.yade,
    pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)"),
]


def config(folder: Path, *overrides: str, name: str = "restart"):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, [f"folder={folder}", *overrides])


class TestWithoutYade:
    def test_the_states_are_the_model_s(self) -> None:
        assert tuple(STATES) == integrator.STATES

    @pytest.mark.parametrize(
        ("errors", "state"),
        [((1.0, 1.2, 1.0), "differences"), ((2.0, 1.2, 1.0), "velocity"), ((2.0, 1.3, 1.0), "full")],
    )
    def test_the_smallest_state_about_as_good_as_the_full_one_follows(self, errors, state) -> None:
        assert sufficient(dict(zip(STATES, errors, strict=True))) == state

    def test_a_partial_state_holds_what_it_says(self) -> None:
        case = Trajectory(EMBEDDED / "drum_small" / "case_004.h5")
        small, middle, full = (partial_state(case, 50, state) for state in STATES)
        assert full.time_s == pytest.approx(0.5)
        assert full.ang_vel.any()
        assert not small.ang_vel.any()
        assert not middle.ang_vel.any()
        assert (middle.vel == full.vel).all()
        displacement = case.read("position", 50, 51) - case.read("position", 49, 50)
        assert small.vel == pytest.approx(displacement[0] / 0.01)

    def test_a_missing_yade_says_how_to_get_it_and_nothing_is_written(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr(dem.shutil, "which", lambda _: None)
        for app, name in ((restart, "restart"), (twins, "twins")):
            with pytest.raises(DependencyError, match="apt-get install yade"):
                app(config(tmp_path, name=name))
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("app", "override", "error", "told"),
        [
            (restart, "case=8", ConfigError, "0 to 7"),
            (restart, "case=-1", ConfigError, "case"),
            (restart, "times_s=[0.1,1.2]", ConfigError, "0.01 to 1.19 s"),
            (restart, "times_s=[0.0]", ConfigError, "times_s"),
            (restart, "times_s=[nan]", ConfigError, "times_s"),
            (restart, "times_s=[soon]", ConfigError, "soon"),
            (restart, "times_s=0.1", ConfigError, "a list of times"),
            (restart, "scene.damping=0.1", DataError, "damping"),
            (twins, "start_s=1.2", ConfigError, "start_s"),
            (twins, "pairs=0", ConfigError, "pairs"),
            (twins, "perturbation_m=3e-4", ConfigError, "throws the bed up"),
        ],
    )
    def test_what_cannot_be_is_refused_before_yade_starts(
        self, app, override, error, told, tmp_path, monkeypatch
    ) -> None:
        monkeypatch.setattr(continuation, "run_dem", lambda *_, **__: pytest.fail("Yade was started"))
        with pytest.raises(error, match=told):
            app(config(tmp_path, override, name=app.__name__))

    @pytest.mark.parametrize("module", ["data_gen.restart", "data_gen.twins"])
    def test_a_user_error_of_the_command_ends_with_status_1(self, module, tmp_path, monkeypatch, capsys) -> None:
        quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]  # handlers would outlive this test's streams
        monkeypatch.setattr(sys, "argv", [module, "case=99", f"hydra.run.dir={tmp_path}", *quiet])
        monkeypatch.delitem(sys.modules, module)
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(module, run_name="__main__")
        assert "remedy" in str(ended.value.code)  # a text: Python prints it and ends with status 1
        assert "Traceback" not in capsys.readouterr().err


@pytest.fixture(scope="module")
def rolling(tmp_path_factory) -> Path:
    """A folder with one case: a grain spins fast on the floor, which drives it along; two others collide in the air."""
    folder = tmp_path_factory.mktemp("rolling")
    scene = Scene.from_config(config(folder, *FEW).scene)
    fine = replace(scene, dem=replace(scene.dem, decimals=continuation.DECIMALS))
    meshes = {name: build_mesh(name, part) for name, part in scene.boundary.items()}
    pos = np.array([[0.0, 0.0, 0.01], [-0.012, 0.0, 0.1], [0.012, 0.002, 0.1]])
    vel = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    ang_vel = np.array([[0.0, 200.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    start = Start(pos, vel, ang_vel, np.full(3, 0.01), np.ones(3, bool))
    run_dem(fine, meshes, start, folder / "case_000.h5", n_frames=6)
    return folder


@needs_yade[0]
@needs_yade[1]
class TestWithYade:
    def test_the_full_state_reproduces_the_next_frame_and_a_spinless_one_does_not(self, rolling, tmp_path) -> None:
        cfg = config(tmp_path, *FEW, f"data.dir={rolling}", "times_s=[0.02]")
        result = restart(cfg)
        differences, velocity, full = (result["position_error_m"][state][0] for state in STATES)
        assert full < 5e-6
        # Sliding drives the spinning grain on by mu g (1 - damping) dt^2 / 2 = 0.21 mm a frame; without spin it brakes.
        assert velocity > 0.21e-3 / 3
        assert differences > velocity
        assert result["state"] == "full"
        stored = json.loads((tmp_path / "restart.json").read_text(), parse_constant=pytest.fail)
        assert stored == result
        assert set(stored) >= {"case", "times_s", "mean_position_error_m", "trivial_position_error_m"}
        lines = table(result).splitlines()
        assert [holds for holds in STATES.values() if any(line.startswith(f"DEM from {holds} ") for line in lines)] == [
            *STATES.values()
        ]
        assert lines[-1].startswith("requires.state=full ")

    def test_twins_start_a_micrometre_apart(self, rolling, tmp_path) -> None:
        result = twins(config(tmp_path, *FEW, f"data.dir={rolling}", "start_s=0.03", "pairs=1", name="twins"))
        (apart,) = result["center_of_mass_max_m"]
        assert 0 < apart < 1e-3
        assert np.isnan(result["angle_of_repose_deg"]).all()  # three grains on a floor have none
        stored = json.loads((tmp_path / "twins_000.json").read_text(), parse_constant=pytest.fail)
        assert stored["times_s"] == pytest.approx([0.03, 0.04, 0.05])
        assert np.shape(stored["distance_m"]) == (1, 3)
        assert stored["mean_distance_m"] == stored["distance_m"][0]
        assert 0.3e-6 < stored["mean_distance_m"][0] < 4e-6
        assert stored["std_distance_m"] == [None] * 3
        assert stored["stored_distance_m"][0] < 1e-9
        assert np.isfinite(result["stored_distance_m"]).all()

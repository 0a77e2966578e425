"""Data of all kinds of scenes: walls that move, grains that leave and enter, several radii, parameters per case."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from scipy.spatial.distance import pdist, squareform

from data_gen import dem
from data_gen.continuation import DECIMALS, continue_dem, stored_state
from data_gen.generate import generate
from data_gen.initial import initial_state
from data_gen.restart import restart
from data_gen.twins import twins
from gns_pyg.config import CONF
from gns_pyg.data.datamodule import open_case
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import Scene
from tests import scenes
from tests.data_gen.test_generate import dem_run, still

NEW = ["pile", "free", "inclined_drum", "hopper_discharge", "silo_stl", "drum_bidisperse", "hopper_friction"]
FLOOR = {"shape": {"kind": "floor", "size_m": [2.0, 2.0]}, "points": 10, "friction_angle_rad": 0.5}
INLET = {"count": 8, "rate_per_s": 90.0, "center_m": [0.3, 0.0, 0.2], "size_m": [0.1, 0.1]}
INLET |= {"velocity_m_s": [0.1, 0.0, -1.5]}
FRICTION = ("scene=hopper_friction", "scene.grains.count=3", "scene.duration_s=0.05")
WEIGHTLESS = [0.0, 0.0, 0.0]
yade = pytest.mark.yade
needs_yade = pytest.mark.skipif(shutil.which("yade") is None, reason="Yade is not installed (apt-get install yade)")


def config(folder: Path, *overrides: str, name: str = "generate"):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, [f"{'out' if name == 'generate' else 'folder'}={folder}", *overrides])


def fine(scene: Scene) -> Scene:
    return replace(scene, dem=replace(scene.dem, decimals=DECIMALS))


@yade
@needs_yade
@pytest.mark.parametrize("name", NEW)
def test_a_scene_of_the_package_makes_cases_that_pass_every_check(name, tmp_path) -> None:
    cfg = config(tmp_path, f"scene={name}", "scene.duration_s=0.05", "case=1")
    scene = Scene.from_config(cfg.scene)
    case = open_case(generate(cfg), scene)
    assert (case.n_frames, case.n_grains) == (6, scene.grains.count)
    assert case.has_active == (scene.outlet is not None)
    assert {r: int((case.radius == r).sum()) for r in scene.grains.radii_m} == dict(scene.grains.counts)
    assert case.mass == pytest.approx(scene.grains.material.density_kg_m3 * 4 / 3 * np.pi * case.radius**3)
    assert Scene.from_config(case.scene).parameters == scene.of_case(1).parameters
    touching = squareform(case.radius[:, None] + case.radius, checks=False)
    assert (pdist(case.read("position", 0, 1)[0]) > touching - 2e-6).all()  # rounded to a micrometre
    assert np.abs(case.read("velocity")).max() < 5


@yade
@needs_yade
@pytest.mark.parametrize("start_s", [0.0, 0.37])
def test_walls_in_yade_are_where_the_model_has_them(start_s, tmp_path, monkeypatch) -> None:
    rotation, along = {"kind": "rotation", "origin_m": [0.1, -0.2, 0.3]}, {"kind": "translation"}
    motions = [
        rotation | {"rate_rad_s": 7.0},
        rotation | {"function": "3 * t**2 + sin(t + 1) - sin(1)"},
        along | {"speed_m_s": -0.8},
        along | {"function": "0.3 * tanh(5 * t) * exp(-t)"},
        {"kind": "oscillation", "amplitude_m": 0.05, "frequency_hz": 9.0},
        {"kind": "none", "axis": []},
    ]
    box = {"kind": "box", "size_m": [0.2, 0.3, 0.4], "center_m": [1.0, 0.0, 0.0]}
    part = {"shape": box, "points": 10, "friction_angle_rad": 0.5}
    parts = {f"part_{k}": part | {"motion": {"axis": [1.0, -2.0, 0.5]} | motion} for k, motion in enumerate(motions)}
    scene = scenes.scene(1, 6, gravity_m_s2=WEIGHTLESS, boundary=parts)
    monkeypatch.setattr(dem, "SCRIPT", Path(__file__).with_name("poses_in_yade.py"))
    monkeypatch.setenv("GNS_POSES", str(tmp_path / "poses.npy"))
    case = dem_run(tmp_path / "case.h5", scene, still([[5.0, 5.0, 5.0]], time_s=start_s))
    poses = np.load(tmp_path / "poses.npy").reshape(6, len(parts), -1, 3)
    for index, (name, moving) in enumerate(scene.boundary.items()):
        corners = torch.from_numpy(build_mesh(name, moving).triangles.reshape(-1, 3).copy())
        for frame, time_s in enumerate(case.times_s):
            at = torch.full((len(corners),), time_s, dtype=torch.float64)
            assert poses[frame, index] == pytest.approx(to_world(moving.motion, corners, at)[0].numpy(), abs=1e-8)
        if moving.motion.moves:
            assert np.abs(poses[-1, index] - poses[0, index]).max() > 1e-3


@pytest.fixture(scope="module")
def falling(tmp_path_factory) -> tuple[Trajectory, Scene]:
    outlet = {"point_m": [0.0, 0.0, -0.02], "normal": [0.0, 0.0, -3.0]}
    scene = fine(scenes.scene(4, 11, boundary={}, outlet=outlet, damping=0.2))
    pos = [[0.0, 0.0, -0.019], [0.1, 0.0, 0.0], [0.2, 0.0, 0.5], [0.3, 0.0, -0.02]]
    start = still(pos, ang_vel=np.full((4, 3), 7.0), vel=np.array([[0.3, 0, 0]] * 3 + [[0, 0, 1.0]]))
    return dem_run(tmp_path_factory.mktemp("outlet") / "case_000.h5", scene, start), scene


@yade
@needs_yade
class TestOutlet:
    def test_a_grain_leaves_in_the_first_frame_beyond_and_is_held_there(self, falling) -> None:
        pos, vel, ang_vel = (falling[0].read(name) for name in ("position", "velocity", "angular_velocity"))
        active = falling[0].active()
        assert active[0].all()
        assert active[-1].tolist() == [False, False, True, True]
        for grain in range(4):
            there = active[:, grain]
            assert (pos[there, grain, 2] >= -0.02).all()
            if there.all():
                continue
            left = int(there.argmin())
            assert not there[left:].any()
            assert pos[left, grain, 2] < -0.02
            assert np.ptp(pos[left:, grain], axis=0) == pytest.approx(0, abs=1e-9)  # chunks of the file round apart
            assert not vel[left:, grain].any()
            assert not ang_vel[left:, grain].any()
            assert ang_vel[left - 1, grain].all()
        fallen_s = np.sqrt(2 * 0.02 / (0.8 * 9.81))  # of grain 1
        assert int(active[:, 1].argmin()) == int(np.ceil(fallen_s / 0.01))

    def test_the_data_module_takes_it_and_refuses_it_for_a_scene_without_an_outlet(self, falling) -> None:
        trajectory, scene = falling
        open_case(trajectory.path, scene)
        with pytest.raises(DataError, match="outlet"):
            open_case(trajectory.path, replace(scene, outlet=None))

    def test_a_run_goes_on_from_a_stored_frame_without_those_that_have_left(self, falling) -> None:
        trajectory, scene = falling
        start = stored_state(trajectory, 4)
        assert start.active.tolist() == [False, True, True, True]
        pos = continue_dem(trajectory, scene, start, 7)
        assert (np.isfinite(pos).all(axis=2) == trajectory.active(4)).all()
        there = trajectory.active(4)
        assert pos[there] == pytest.approx(trajectory.read("position", 4)[there], abs=1e-6)


@yade
@needs_yade
class TestInlet:
    def test_grains_enter_as_planned_and_are_real(self, tmp_path) -> None:
        scene = fine(scenes.scene(10, 21, boundary={"floor": FLOOR}, inlet=INLET))
        plan = entries(scene)
        pos = np.concatenate([[[0.0, 0.0, 0.01], [0.1, 0.0, 0.01]], plan.pos])
        start = still(pos.tolist(), active=np.arange(10) < 2)
        case = dem_run(tmp_path / "case.h5", scene, start)
        open_case(case.path, scene)
        active, pos, vel = case.active(), case.read("position"), case.read("velocity")
        assert active[:, :2].all()
        for entry in range(8):
            grain, first = 2 + entry, int(np.ceil(plan.time_s[entry] / 0.01 - 1e-9))
            assert active[:, grain].tolist() == [frame >= first for frame in range(21)]
            assert pos[: first + 1, grain] == pytest.approx(np.tile(plan.pos[entry], (first + 1, 1)), abs=1e-9)
            assert vel[first, grain] == pytest.approx(plan.vel[entry], abs=1e-9)
            assert not vel[:first, grain].any()
            assert np.ptp(pos[first : first + 3, grain, 2]) > 0.01
            assert pos[first:, grain, 2].min() > 0.005  # the floor holds them
        assert [int(n) for n in active.sum(axis=1)] == [2 + int((plan.time_s <= t + 1e-9).sum()) for t in case.times_s]
        halfway = stored_state(case, 5)  # four have entered; the others still do
        assert halfway.active.sum() == 6
        again = continue_dem(case, scene, halfway, 4)
        assert (np.isfinite(again).all(axis=2) == active[5:9]).all()
        assert again[active[5:9]] == pytest.approx(pos[5:9][active[5:9]], abs=1e-4)

    def test_a_blocked_inlet_stops_with_the_reason(self, tmp_path) -> None:
        scene = scenes.scene(9, 6, boundary={}, inlet=INLET, gravity_m_s2=WEIGHTLESS)
        plan = entries(scene)
        start = still([(plan.pos[1] + [0.0, 0.0, 0.01]).tolist(), *plan.pos.tolist()], active=np.arange(9) < 1)
        with pytest.raises(DataError, match=r"scene\.inlet is blocked at t = 0\.03 s: grain 2 [\s\S]*rate_per_s"):
            dem_run(tmp_path / "case.h5", scene, start)
        assert list(tmp_path.iterdir()) == []


class TestVary:
    @pytest.fixture
    def written(self, tmp_path) -> Path:
        """Case 2 in a folder."""
        scene = Scene.from_config(config(tmp_path, *FRICTION).scene).of_case(2)
        pos = np.tile([[0.0, 0.0, 0.3], [0.05, 0.0, 0.3], [0.0, 0.05, 0.3]], (6, 1, 1))
        scenes.write_case(tmp_path / "case_002.h5", scene, pos)
        return tmp_path

    @pytest.mark.parametrize("values", ["[0.15,0.3,0.45,0.6,0.75]", "[0.1,0.2,0.45]"])
    def test_a_finished_case_does_not_mind_the_values_of_others(self, values, written, capsys) -> None:
        generate(config(written, *FRICTION, f"scene.vary.friction_angle_rad={values}", "case=2"))
        assert "nothing to do" in capsys.readouterr().out

    def test_a_finished_case_minds_its_own_value(self, written) -> None:
        with pytest.raises(DataError, match=r"friction_angle_rad: 0\.45 in the file, 0\.5 now"):
            generate(config(written, *FRICTION, "scene.vary.friction_angle_rad=[0.15,0.3,0.5]", "case=2"))

    def test_the_data_module_takes_any_value_only_where_the_scene_says_that_it_varies(self, written) -> None:
        scene = Scene.from_config(config(written, *FRICTION).scene)
        case = open_case(written / "case_002.h5", scene)
        assert Scene.from_config(case.scene).grains.material.friction_angle_rad == 0.45
        with pytest.raises(DataError, match="friction_angle_rad"):
            open_case(written / "case_002.h5", replace(scene, vary={}))


def test_a_radius_that_the_scene_does_not_list_is_refused(tmp_path) -> None:
    scene = scenes.scene(3, 2)
    scene.grains.radius_m = [0.01, 0.005]
    scenes.write_case(tmp_path / "case.h5", scene, np.tile([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], (2, 1, 1)))
    open_case(tmp_path / "case.h5", scene)
    with h5py.File(tmp_path / "case.h5", "r+") as file:
        file["particles/grains/radius"][1] = 0.007
    with pytest.raises(DataError, match=r"grain 1 has a radius of 0\.007 m \(scene: 0\.005 m or 0\.01 m\)"):
        open_case(tmp_path / "case.h5", scene)


@yade
@needs_yade
def test_restarts_and_twins_of_a_scene_with_an_outlet_and_two_radii(tmp_path) -> None:
    few = ["scene=hopper_discharge", "scene.grains.count=6", "scene.dem.dt_s=1e-4"]
    few += ["scene.grains.radius_m=[0.008,0.012]"]
    scene = fine(Scene.from_config(config(tmp_path, *few).scene))
    meshes = {part: build_mesh(part, value) for part, value in scene.boundary.items()}
    start = initial_state(scene, meshes, 0)
    start.pos[0], start.vel[0] = [0.0, 0.0, 0.005], [0.0, 0.0, -0.3]  # leaves soon
    dem.run_dem(scene, meshes, start, tmp_path / "case_000.h5", n_frames=6)
    stored = Trajectory(tmp_path / "case_000.h5")
    assert stored.active().sum(axis=0).tolist() == [2, 6, 6, 6, 6, 6]
    assert sorted(stored.radius) == [0.008] * 3 + [0.012] * 3
    given = [*few, f"data.dir={tmp_path}"]
    errors = restart(config(tmp_path, *given, "times_s=[0.03]", name="restart"))["position_error_m"]
    assert errors["full"][0] < 1e-5
    assert np.isfinite([*errors.values()]).all()
    apart = twins(config(tmp_path, *given, "start_s=0.03", "pairs=1", name="twins"))
    assert np.isfinite(apart["distance_m"]).all()
    assert apart["distance_m"][0, 0] < 4e-6
    assert apart["stored_distance_m"].max() < 1e-4

"""Exports, read back by other people's programs."""

import subprocess
import sys
import warnings
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from gns_pyg.config import CONF
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import ConfigError, DataError
from gns_pyg.evaluation.errors import positions, present
from gns_pyg.export import export
from tests import scenes

ROOT = Path(__file__).parents[2]


def write(*overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return export(compose("export", list(overrides)))


def series(path):
    """A .pvd's times and files."""
    entries = ElementTree.parse(path).getroot().iter("DataSet")
    return [(float(entry.get("timestep")), path.parent / entry.get("file")) for entry in entries]


def test_vtk_holds_every_frame_of_grains_with_their_fields(tmp_path):
    scenes.rotating_box_case(tmp_path / "case.h5", n_frames=4)
    case, folder = Trajectory(tmp_path / "case.h5"), write(f"trajectory={tmp_path / 'case.h5'}")
    assert folder == tmp_path / "case_vtk"
    frames = series(folder / "grains.pvd")
    assert [time for time, _ in frames] == case.times_s.tolist()
    for frame, (_, file) in enumerate(frames):
        grains, vel = meshio.read(file), case.read("velocity", frame, frame + 1)[0]
        assert np.array_equal(grains.points, case.read("position", frame, frame + 1)[0])
        assert np.array_equal(grains.point_data["velocity"], vel)
        assert np.array_equal(grains.point_data["speed"], np.linalg.norm(vel, axis=1))
        assert np.array_equal(grains.point_data["radius"], case.radius)
        spin = case.read("angular_velocity", frame, frame + 1)[0]
        assert np.array_equal(grains.point_data["angular_velocity"], spin)


def test_vtk_s_boundary_turns_as_the_grains_in_it_do(tmp_path):
    """The box of the scene turns about x at 8 rad/s; corners turn by hand."""
    scenes.rotating_box_case(tmp_path / "case.h5", n_frames=4, rate_rad_s=8.0)
    body = Trajectory(tmp_path / "case.h5").boundary["drum"]["vertices"]
    frames = series(write(f"trajectory={tmp_path / 'case.h5'}") / "boundary.pvd")
    assert len(frames) == 4
    for time_s, file in frames:
        walls, (cos, sin) = meshio.read(file), (np.cos(8.0 * time_s), np.sin(8.0 * time_s))
        turned = body @ np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
        assert np.allclose(walls.points, turned, rtol=0, atol=1e-12)
        assert np.allclose(walls.point_data["velocity"], np.cross([8.0, 0, 0], turned), rtol=0, atol=1e-11)
        assert len(walls.cells_dict["triangle"]) == 12
        assert (walls.cell_data["part"][0] == 0).all()


def test_vtk_leaves_absent_grains_out_and_needs_no_boundary(tmp_path):
    scenes.passing_case(tmp_path / "case.h5")
    pos = positions(Trajectory(tmp_path / "case.h5"))
    folder = write(f"trajectory={tmp_path / 'case.h5'}", f"out={tmp_path / 'vtk'}")
    for there, frame, (_, file) in zip(present(pos), pos, series(folder / "grains.pvd"), strict=True):
        grains = meshio.read(file)
        assert np.array_equal(grains.point_data["grain"], np.flatnonzero(there))
        assert np.array_equal(grains.points, frame[there])
    assert not (folder / "boundary.pvd").exists()


@pytest.mark.parametrize("make", [scenes.rotating_box_case, scenes.passing_case])
def test_mdanalysis_reads_our_positions_velocities_and_times(make, tmp_path):
    make(tmp_path / "case.h5")
    case, file = Trajectory(tmp_path / "case.h5"), write(f"trajectory={tmp_path / 'case.h5'}", "format=mdanalysis")
    with warnings.catch_warnings():  # of its own imports
        warnings.simplefilter("ignore")
        from MDAnalysis.coordinates.H5MD import H5MDReader

        frames = [
            (ts.time, ts.positions.astype(float), ts.velocities.astype(float)) for ts in H5MDReader(str(file))
        ]  # its units: ps, Angstrom, Angstrom/ps; its numbers: float32
    assert np.allclose([time for time, _, _ in frames], 1e12 * case.times_s)
    assert np.allclose([pos for _, pos, _ in frames], 1e10 * case.read("position"), rtol=1e-6, atol=1e3)
    assert np.allclose([vel for _, _, vel in frames], 0.01 * case.read("velocity"), rtol=1e-6, atol=1e-8)


def test_mdanalysis_reads_our_xyz_and_every_column_is_named(tmp_path):
    scenes.passing_case(tmp_path / "case.h5")
    case, file = Trajectory(tmp_path / "case.h5"), write(f"trajectory={tmp_path / 'case.h5'}", "format=xyz")
    pos, vel = positions(case), case.read("velocity")
    frames = file.read_text().split("Properties=")
    assert len(frames) == case.n_frames + 1
    for frame, (there, text) in enumerate(zip(present(pos), frames[1:], strict=True)):
        head, *rows = text.splitlines()
        names, time, _ = head.split(" ", 2)
        assert names == "species:S:1:pos:R:3:velo:R:3:radius:R:1:id:I:1"
        assert float(time.removeprefix("Time=")) == pytest.approx(case.times_s[frame])
        table = np.array([row.split()[1:] for row in rows[: there.sum()]], float)
        expected = [pos[frame, there], vel[frame, there], case.radius[there, None], np.flatnonzero(there)[:, None]]
        assert np.allclose(table, np.concatenate(expected, axis=1), rtol=1e-8, atol=0)
    scenes.rotating_box_case(tmp_path / "box.h5", n_frames=3)  # its reader wants the same particles in all frames
    with warnings.catch_warnings():  # of its own imports
        warnings.simplefilter("ignore")
        from MDAnalysis.coordinates.XYZ import XYZReader

        read = [ts.positions.copy() for ts in XYZReader(str(write(f"trajectory={tmp_path / 'box.h5'}", "format=xyz")))]
    assert np.allclose(read, Trajectory(tmp_path / "box.h5").read("position"), rtol=1e-6, atol=1e-8)


def test_a_folder_that_is_no_export_is_left_alone(tmp_path):
    scenes.passing_case(tmp_path / "case.h5")
    wanted = f"trajectory={tmp_path / 'case.h5'}"
    with pytest.raises(ConfigError, match="out"):
        write(wanted, f"out={tmp_path}")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match="out"):
        write(wanted, f"out={tmp_path / 'file'}")
    assert (tmp_path / "file").read_text() == "mine"
    assert write(wanted, f"out={tmp_path / 'vtk'}") == write(wanted, f"out={tmp_path / 'vtk'}")


@pytest.mark.parametrize(
    ("overrides", "error", "match"),
    [
        ([], ConfigError, "trajectory"),
        (["trajectory=nowhere.h5"], DataError, "no such file"),
        (["trajectory=nowhere.h5", "format=vtp"], ConfigError, "vtk or xyz or mdanalysis"),
    ],
)
def test_what_cannot_be_is_refused(overrides, error, match):
    with pytest.raises(error, match=match):
        write(*overrides)


def test_the_command_says_where_it_wrote_and_no_more(tmp_path):
    scenes.free_flight_case(tmp_path / "case.h5", n_frames=3)
    words = [sys.executable, "-m", "gns_pyg.export", f"trajectory={tmp_path / 'case.h5'}"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True)
    assert (done.stdout, done.stderr) == (f"{tmp_path / 'case.h5'} -> {tmp_path / 'case_vtk'}\n", "")

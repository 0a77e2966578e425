"""Writes a trajectory for other programs: `python -m gns_pyg.export trajectory=... format=vtk` (conf/export.yaml)."""

from pathlib import Path

from omegaconf import DictConfig

from gns_pyg.config import check_keys, require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.launch import launch
from gns_pyg.report.mdanalysis import write_mdanalysis
from gns_pyg.report.vtk import write_vtk
from gns_pyg.report.xyz import write_xyz

FORMATS = {  # what writes it, and the end of its name
    "vtk": (write_vtk, "_vtk"),
    "xyz": (write_xyz, ".xyz"),
    "mdanalysis": (write_mdanalysis, "_mdanalysis.h5md"),
}


def export(cfg: DictConfig) -> Path:
    """Writes `trajectory` in `format` to `out`; returns where it is.

    Raises:
        GnsError: for a trajectory that cannot be read, an unknown format, or a place that cannot be written to.
    """
    check_keys(cfg, ["trajectory", "format", "out"])
    require(cfg.trajectory is not None, "trajectory", "null", "a trajectory file", "trajectory=runs/.../rollout.h5")
    require(cfg.format in FORMATS, "format", cfg.format, " or ".join(FORMATS), "pick one of them")
    write, ending = FORMATS[cfg.format]
    source = Path(cfg.trajectory)
    written = write(Trajectory(source), cfg.out or source.with_name(source.stem + ending))
    print(f"{source} -> {written}", flush=True)
    return written


def main() -> None:
    """gns-export"""
    launch("export", export)


if __name__ == "__main__":
    main()

"""The trajectory file's layout (H5MD 1.1): keys, units and what a valid file must hold. numpy, h5py and errors only."""

import h5py
import numpy as np

H5MD_VERSION = (1, 1)
GRAINS = "particles/grains"
UNITS = {"position": "m", "velocity": "m s-1", "angular_velocity": "rad s-1"}
FIXED_UNITS = {"radius": "m", "mass": "kg"}
OPTIONAL = {"gns_pyg": {"angular_velocity"}}  # by creator: a model's state need not hold rotation; DEM's does
RUN_KEYS = ("wall_clock_s", "cores", "steps", "dt_s", "creator", "creator_version")


def violations(file: h5py.File) -> list[str]:
    """Lists everything in `file` that breaks the layout; an empty list is a valid file.

    Positions are checked for finite values frame block by frame block, so memory stays bounded.
    """
    wrong: list[str] = []
    if "h5md" not in file or "version" not in file["h5md"].attrs:
        wrong.append("/h5md: attribute `version` missing; expected an H5MD 1.x file")
    if GRAINS not in file:
        return [*wrong, f"/{GRAINS}: group missing"]
    grains = file[GRAINS]
    if "box" not in grains:
        wrong.append(f"/{GRAINS}/box: group missing")
    n_frames = n_grains = None
    creator = _text(file["parameters"].attrs.get("creator")) if "parameters" in file else None
    for name, unit in UNITS.items():
        if name not in grains and name in OPTIONAL.get(creator or "", ()):
            continue
        if f"{name}/value" not in grains or f"{name}/time" not in grains:
            wrong.append(f"/{GRAINS}/{name}: `value` or `time` missing")
            continue
        value, time = grains[name]["value"], grains[name]["time"]
        if value.ndim != 3 or value.shape[2] != 3 or value.dtype.kind != "f":
            wrong.append(
                f"/{GRAINS}/{name}/value: {value.dtype} {value.shape}, expected floats (n_frames, n_grains, 3)"
            )
            continue
        n_frames, n_grains = (n_frames or value.shape[0]), (n_grains or value.shape[1])
        if value.shape[:2] != (n_frames, n_grains):
            wrong.append(f"/{GRAINS}/{name}/value: shape {value.shape}, expected ({n_frames}, {n_grains}, 3)")
        if (found := _text(value.attrs.get("unit"))) != unit:
            wrong.append(f"/{GRAINS}/{name}/value: unit {found!r}, expected {unit!r}")
        if time.shape != (value.shape[0],):
            wrong.append(f"/{GRAINS}/{name}/time: shape {time.shape}, expected ({value.shape[0]},)")
        elif not np.all(np.diff(time[:]) > 0):
            wrong.append(f"/{GRAINS}/{name}/time: not strictly increasing")
        wrong += _not_finite(value, f"/{GRAINS}/{name}/value")
    for name in FIXED_UNITS:
        if name not in grains:
            wrong.append(f"/{GRAINS}/{name}: missing")
        elif n_grains is not None and grains[name].shape != (n_grains,):
            wrong.append(f"/{GRAINS}/{name}: shape {grains[name].shape}, expected ({n_grains},)")
        elif not np.all(grains[name][:] > 0):
            wrong.append(f"/{GRAINS}/{name}: holds a value that is not above 0")
    if "parameters" not in file or "scene" not in file["parameters"].attrs:
        wrong.append("/parameters: attribute `scene` missing")
    else:
        missing = [key for key in RUN_KEYS if key not in file["parameters"].attrs]
        wrong += [f"/parameters: attribute `{key}` missing" for key in missing]
    return wrong


def _not_finite(value: h5py.Dataset, where: str) -> list[str]:
    block = 64
    for start in range(0, value.shape[0], block):
        bad = ~np.isfinite(value[start : start + block])
        if bad.any():
            frame, grain = np.argwhere(bad.any(axis=2))[0]
            return [f"{where}: not finite at frame {start + frame}, grain {grain}"]
    return []


def _text(value: object) -> str | None:
    return value.decode() if isinstance(value, bytes) else value  # type: ignore[return-value]

"""The trajectory file's layout (H5MD 1.1): keys, units and what a valid file must hold. numpy and h5py only."""

import json
import math

import h5py
import numpy as np

H5MD_VERSION = (1, 1)
GRAINS = "particles/grains"
UNITS = {"position": "m", "velocity": "m s-1", "angular_velocity": "rad s-1"}
FIXED_UNITS = {"radius": "m", "mass": "kg"}
OPTIONAL = {"gns_pyg": {"angular_velocity"}}  # by creator: a model's state need not hold rotation; DEM's does
NUMBERS = "fiu"  # numpy's kinds of real numbers
BLOCK_BYTES = 2**24  # of a field that is checked at once
MOST_PACKED = 1000  # a data set may be this many times as large as the file that holds it; gzip packs 1032 to 1
RUN_KEYS = ("wall_clock_s", "cores", "steps", "dt_s", "creator", "creator_version")


def violations(file: h5py.File) -> list[str]:
    """Lists everything in `file` that breaks the layout; an empty list is a valid file.

    Nothing is read before all links and sizes are known to be sound, and fields are checked for finite values block by
    block, so memory stays bounded by the file's size, whatever sizes it claims.
    """
    if wrong := _foreign(file):
        return wrong
    header, parameters = file.get("h5md"), file.get("parameters")
    if not isinstance(header, h5py.Group) or "version" not in header.attrs:
        wrong.append("/h5md: attribute `version` missing; expected an H5MD 1.x file")
    creator = None
    if not isinstance(parameters, h5py.Group):
        wrong.append("/parameters: group missing")
    else:
        creator = _text(parameters.attrs.get("creator"))
        wrong += _not_json(parameters, "scene")
        wrong += [f"/parameters: attribute `{key}` missing" for key in RUN_KEYS if key not in parameters.attrs]
    if isinstance(grains := file.get(GRAINS), h5py.Group):
        wrong += _wrong_grains(grains, creator or "")
    else:
        wrong.append(f"/{GRAINS}: group missing")
    boundary = file.get("boundary", {})
    if not isinstance(boundary, h5py.Group) and "boundary" in file:
        return [*wrong, "/boundary: a data set, expected a group"]
    return wrong + [text for name in boundary for text in _wrong_part(file, f"boundary/{name}")]


def _foreign(file: h5py.File) -> list[str]:
    """What leads out of the file, or claims to be far larger than the file could hold."""
    wrong: list[str] = []
    stored = file.id.get_filesize()

    def look(name: str, link: object) -> None:
        if isinstance(link, h5py.ExternalLink):
            wrong.append(f"/{name}: a link to another file")
        elif isinstance(link, h5py.HardLink) and isinstance(found := file[name], h5py.Dataset):
            if found.is_virtual or found.external:
                wrong.append(f"/{name}: its values lie in another file")
            for what, shape in (("values", found.shape or ()), ("a chunk", found.chunks or ())):
                if (claimed := math.prod(shape) * found.dtype.itemsize) > MOST_PACKED * stored:
                    wrong.append(f"/{name}: {what} of {claimed / 1e6:.3g} MB in a file of {stored / 1e6:.3g} MB")

    file.visititems_links(look)
    return wrong


def _wrong_grains(grains: h5py.Group, creator: str) -> list[str]:
    wrong: list[str] = []
    if not isinstance(grains.get("box"), h5py.Group):
        wrong.append(f"/{GRAINS}/box: group missing")
    size: tuple[int, int] | None = None  # frames and grains of the first field; the others must be like it
    for name, unit in UNITS.items():
        if name not in grains and name in OPTIONAL.get(creator, ()):
            continue
        value, time = _dataset(grains, f"{name}/value", unit, wrong), _dataset(grains, f"{name}/time", "s", wrong)
        if value is None or time is None:
            continue
        where = f"/{GRAINS}/{name}"
        if value.ndim != 3 or value.shape[2] != 3 or value.dtype.kind != "f":
            wrong.append(f"{where}/value: {value.dtype} {value.shape}, expected floats (n_frames, n_grains, 3)")
            continue
        size = size or value.shape[:2]
        if value.shape[:2] != size:
            wrong.append(f"{where}/value: shape {value.shape}, expected ({size[0]}, {size[1]}, 3)")
        if 0 in value.shape:
            wrong.append(
                f"{where}/value: {value.shape[0]} frames of {value.shape[1]} grains, expected at least 1 of each"
            )
        if time.shape != value.shape[:1] or time.dtype.kind not in NUMBERS:
            wrong.append(f"{where}/time: {time.dtype} {time.shape}, expected numbers ({value.shape[0]},)")
        elif not (np.isfinite(time[:]).all() and (np.diff(time[:]) > 0).all()):
            wrong.append(f"{where}/time: not finite and strictly increasing")
        wrong += _not_finite(value, f"{where}/value")
    if "active" in grains and (active := _dataset(grains, "active/value", None, wrong)) is not None:
        if active.shape != size or active.dtype != np.uint8:
            wrong.append(f"/{GRAINS}/active/value: {active.dtype} {active.shape}, expected uint8 {size}")
        elif not (active[:] <= 1).all():
            wrong.append(f"/{GRAINS}/active/value: holds a value that is neither 0 nor 1")
    for name, unit in FIXED_UNITS.items():
        if (fixed := _dataset(grains, name, unit, wrong)) is None:
            continue
        n_grains = fixed.shape[:1] if size is None else size[1:]
        if fixed.ndim != 1 or fixed.shape != n_grains or fixed.dtype.kind not in NUMBERS:
            wrong.append(f"/{GRAINS}/{name}: {fixed.dtype} {fixed.shape}, expected numbers {n_grains}")
        elif not (np.isfinite(fixed[:]).all() and (fixed[:] > 0).all()):
            wrong.append(f"/{GRAINS}/{name}: holds a value that is not finite and above 0")
    return wrong


def _wrong_part(file: h5py.File, path: str) -> list[str]:
    part = file.get(path)
    if not isinstance(part, h5py.Group):
        return [f"/{path}: expected a group"]
    wrong = _not_json(part, "motion")
    vertices, triangles = _dataset(part, "vertices", "m", wrong), _dataset(part, "triangles", None, wrong)
    for data, kinds, expected in ((vertices, "f", "floats (n, 3)"), (triangles, "iu", "whole numbers (m, 3)")):
        if data is not None and (data.ndim != 2 or data.shape[1] != 3 or data.dtype.kind not in kinds):
            wrong.append(f"{data.name}: {data.dtype} {data.shape}, expected {expected}")
    if wrong or vertices is None or triangles is None:
        return wrong
    if not np.isfinite(vertices[:]).all():
        wrong.append(f"{vertices.name}: not all finite")
    if not ((triangles[:] >= 0) & (triangles[:] < len(vertices))).all():
        wrong.append(f"{triangles.name}: not all are rows of vertices (0 to {len(vertices) - 1})")
    return wrong


def _dataset(group: h5py.Group, path: str, unit: str | None, wrong: list[str]) -> h5py.Dataset | None:
    """The data set at `path`; what is wrong with its presence or unit is added to `wrong`."""
    found, where = group.get(path), f"{group.name}/{path}"
    if not isinstance(found, h5py.Dataset):
        wrong.append(f"{where}: missing" if found is None else f"{where}: not a data set")
        return None
    if unit is not None and (given := _text(found.attrs.get("unit"))) != unit:
        wrong.append(f"{where}: unit {given!r}, expected {unit!r}")
    return found


def _not_json(group: h5py.Group, name: str) -> list[str]:
    if name not in group.attrs:
        return [f"{group.name}: attribute `{name}` missing"]
    try:
        value = json.loads(group.attrs[name])
    except (TypeError, ValueError) as error:
        return [f"{group.name}: attribute `{name}` is not JSON ({error})"]
    return [] if isinstance(value, dict) else [f"{group.name}: attribute `{name}` is no JSON object"]


def _not_finite(value: h5py.Dataset, where: str) -> list[str]:
    block = max(1, BLOCK_BYTES // max(1, math.prod(value.shape[1:]) * value.dtype.itemsize))
    for start in range(0, value.shape[0], block):
        bad = ~np.isfinite(value[start : start + block])
        if bad.any():
            frame, grain = np.argwhere(bad.any(axis=2))[0]
            return [f"{where}: not finite at frame {start + frame}, grain {grain}"]
    return []


def _text(value: object) -> str | None:
    """An attribute as text; None where there is none."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value if value is None or isinstance(value, str) else repr(value)

"""Reading and writing trajectories (H5MD files). Runs in Yade's Python too: numpy, h5py and errors only."""

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gns_pyg.data.heap import endless_heap
from gns_pyg.data.schema import FIXED_UNITS, GRAINS, H5MD_VERSION, RUN_KEYS, UNITS, violations
from gns_pyg.errors import DataError, StorageError
from gns_pyg.files import REMEDY, clean_stale, remove, unfinished

CHUNK_FRAMES = 8
STARTERS = 8  # grains whose first positions tell a run


class Trajectory:
    """One case, read lazily: opening validates the file, frames are read when asked for.

    Args:
        path: an H5MD file written by `TrajectoryWriter`.
        every: reads only every so many frames, the first among them, as if no other were stored.

    Attributes:
        n_frames, n_grains: size.
        fields: what `read` can read, e.g. position.
        times_s: (n_frames,) float64.
        radius, mass: (n_grains,) float64, m and kg.
        scene: the scene as resolved, a plain dict.
        has_active: whether grains leave or enter, so that not all of them are there in every frame.
        run: the run that made it: wall_clock_s, cores, steps, dt_s, creator, creator_version, case, ...

    Raises:
        DataError: if the file is missing, is not HDF5, is truncated, or breaks the layout (all violations at once).
    """

    def __init__(self, path: str | Path, every: int = 1) -> None:
        self.path, self.every = Path(path), every
        if not self.path.is_file():
            raise DataError(
                self.path, "no such file", "a trajectory file (.h5)", "generate it: python -m data_gen.generate"
            )
        try:
            if endless := endless_heap(self.path):
                raise OSError(endless)
            with h5py.File(self.path, "r") as file:
                wrong = violations(file)
                if not wrong:
                    self._read_fixed(file)
        except Exception as error:  # h5py has all kinds for damaged bytes, SystemError and UnicodeError among them
            wrong = [f"cannot be read as HDF5 ({error})"]
        if wrong:
            raise DataError(
                self.path,
                "; ".join(wrong),
                "a complete H5MD trajectory as docs/data_format.md lays it out",
                "delete the file and generate it again, or correct what is listed",
            )
        self._file: h5py.File | None = None
        self._hash: str | None = None

    def _read_fixed(self, file: h5py.File) -> None:
        grains = file[GRAINS]
        self._stored, self.n_grains = grains["position/value"].shape[:2]
        self.fields = [name for name in UNITS if name in grains]
        self.has_active = "active" in grains
        self.times_s = grains["position/time"][:: self.every].astype(np.float64)
        self.n_frames = len(self.times_s)
        self.radius = grains["radius"][:].astype(np.float64)
        self.mass = grains["mass"][:].astype(np.float64)
        attributes = dict(file["parameters"].attrs)
        self.scene: dict[str, Any] = json.loads(attributes.pop("scene"))
        if self.every > 1:
            self.scene["frame_dt_s"] *= self.every
        self.run = {key: value.item() if hasattr(value, "item") else value for key, value in attributes.items()}

    def read(self, field: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Returns frames [start, stop) of `field` (position, velocity, angular_velocity), float64 (n, n_grains, 3)."""
        if self._file is None:  # opened on first use, so that data-loader workers hold handles of their own
            self._file = h5py.File(self.path, "r")
        if field not in self.fields:
            raise DataError(self.path, f"no {field}", f"the field {field}", "use a DEM run, which stores all fields")
        return self._file[GRAINS][field]["value"][self._frames(start, stop)].astype(np.float64)

    def active(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Whether each grain is in the scene in frames [start, stop), bool (n, n_grains)."""
        if not self.has_active:
            return np.ones((len(range(self.n_frames)[start:stop]), self.n_grains), bool)
        if self._file is None:
            self._file = h5py.File(self.path, "r")
        return self._file[GRAINS]["active/value"][self._frames(start, stop)].astype(bool)

    def _frames(self, start: int, stop: int | None) -> slice:
        chosen = range(self._stored)[:: self.every][start:stop]
        return slice(chosen.start, chosen.stop, chosen.step)

    @property
    def boundary(self) -> dict[str, dict[str, Any]]:
        """Part name -> {"vertices": (n, 3) m, "triangles": (m, 3), "motion": dict}, at t = 0."""
        with h5py.File(self.path, "r") as file:
            return {
                name: {
                    "vertices": part["vertices"][:],
                    "triangles": part["triangles"][:],
                    "motion": json.loads(part.attrs["motion"]),
                }
                for name, part in file.get("boundary", {}).items()
            }

    @property
    def frame_dt_s(self) -> float:
        """Time between frames, s (the mean; 0 for a single frame)."""
        return float((self.times_s[-1] - self.times_s[0]) / max(self.n_frames - 1, 1))

    def content_hash(self) -> str:
        """A hash of all stored positions: the same run has the same hash whatever its file is called, however many of
        its frames are read."""
        if self._hash is None:
            whole = self if self.every == 1 else Trajectory(self.path)
            self._hash = hashlib.sha256(np.ascontiguousarray(whole.read("position")).tobytes()).hexdigest()[:16]
        return self._hash

    def start(self) -> np.ndarray:
        """What tells a run by its first frame, whenever it was recorded and however rounded: the mean position of all
        grains and the positions of the first few, m, (1 to 9, 3)."""
        pos = self.read("position", 0, 1)[0]
        return np.concatenate([pos.mean(axis=0, keepdims=True), pos[:STARTERS]])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None}


class TrajectoryWriter:
    """Writes a trajectory frame by frame under a temporary name; `finish` gives it its final name.

    Used as a context manager: leaving it without `finish` removes the temporary file.

    Args:
        path: final name of the file.
        scene: the scene as resolved (plain dict).
        radius, mass: (n_grains,), m and kg.
        boundary: part name -> {"vertices": (n, 3) m, "triangles": (m, 3), "motion": dict}.
        decimals: digits kept after the point (HDF5's scale-offset filter, SI units) of every field to be written:
            all three for a DEM run; a model whose state has no rotation leaves `angular_velocity` out.
        with_active: grains leave or enter, so that every frame says which ones are there.

    Raises:
        StorageError: from every method, if the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Mapping[str, Any],
        radius: np.ndarray,
        mass: np.ndarray,
        boundary: Mapping[str, Mapping[str, Any]],
        decimals: Mapping[str, int],
        with_active: bool = False,
    ) -> None:
        self.path = Path(path)
        self._temporary = unfinished(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            clean_stale(self.path)
            self._file = h5py.File(self._temporary, "w")
            self._create(scene, radius, mass, boundary, decimals, with_active)
        except (OSError, RuntimeError) as error:
            self.__exit__()
            raise self._not_written(error) from None

    def _create(
        self,
        scene: Mapping[str, Any],
        radius: np.ndarray,
        mass: np.ndarray,
        boundary: Mapping[str, Mapping[str, Any]],
        decimals: Mapping[str, int],
        with_active: bool,
    ) -> None:
        self._n_frames, self._n_grains = 0, len(radius)
        header = self._file.create_group("h5md")
        header.attrs["version"] = H5MD_VERSION
        header.create_group("author").attrs["name"] = "gns_pyg"
        units = header.create_group("modules/units")  # H5MD's module that gives the attribute `unit` its meaning
        units.attrs["version"], units.attrs["system"] = (1, 0), "SI"
        grains = self._file.create_group(GRAINS)
        box = grains.create_group("box")
        box.attrs["dimension"] = 3
        box.attrs["boundary"] = ["none"] * 3
        for name, values in (("radius", radius), ("mass", mass)):
            grains.create_dataset(name, data=np.asarray(values, np.float64)).attrs["unit"] = FIXED_UNITS[name]
        grains.create_dataset("species", data=np.zeros(len(radius), np.int32))
        self._pending: dict[str, list[np.ndarray]] = {name: [] for name in decimals}
        self._decimals = dict(decimals)
        self._fields = [name for name in UNITS if name in decimals]
        for name in self._fields:
            self._create_field(grains.create_group(name), UNITS[name], decimals[name])
        if with_active:
            grains.create_group("active").create_dataset(
                "value",
                (0, self._n_grains),
                np.uint8,
                maxshape=(None, self._n_grains),
                chunks=(CHUNK_FRAMES, self._n_grains),
                compression="gzip",
            )
        self._shared = [*self._fields[1:], *(["active"] if with_active else [])]
        for name in self._shared:  # H5MD: elements sampled together share step and time
            for shared in ("step", "time"):
                grains[name][shared] = grains["position"][shared]
        for name, part in boundary.items():
            group = self._file.create_group(f"boundary/{name}")
            group.create_dataset("vertices", data=np.asarray(part["vertices"], np.float64)).attrs["unit"] = "m"
            group.create_dataset("triangles", data=np.asarray(part["triangles"], np.int32))
            group.attrs["motion"] = json.dumps(part["motion"])
        self._file.create_group("parameters").attrs["scene"] = json.dumps(scene)

    def _create_field(self, group: h5py.Group, unit: str, decimals: int) -> None:
        if group.name.endswith("position"):
            group.create_dataset("step", (0,), np.int64, maxshape=(None,))
            group.create_dataset("time", (0,), np.float64, maxshape=(None,)).attrs["unit"] = "s"
        value = group.create_dataset(
            "value",
            (0, self._n_grains, 3),
            np.float64,
            maxshape=(None, self._n_grains, 3),
            chunks=(CHUNK_FRAMES, self._n_grains, 3),
            scaleoffset=decimals,  # packs bits, so that shuffling bytes afterwards would only hide repeats from gzip
            fillvalue=1e30,  # the filter takes values within 10^-decimals of the fill value, 0 by default, for it
            compression="gzip",
            compression_opts=6,
        )
        value.attrs["unit"] = unit

    def append(
        self,
        step: int,
        time_s: float,
        pos: np.ndarray,
        vel: np.ndarray,
        ang_vel: np.ndarray | None = None,
        active: np.ndarray | None = None,
    ) -> None:
        """Adds a frame: grain centres (n_grains, 3) m, velocities m/s, angular velocities rad/s, who is there (bool).

        Raises:
            DataError: if a value is not finite; nothing of this frame is written.
        """
        given = dict(zip(UNITS, (pos, vel, ang_vel), strict=True))
        frame = {name: np.array(given[name], np.float64) for name in self._fields}
        for name, values in frame.items():
            if not np.isfinite(values).all():
                grain = int(np.argwhere(~np.isfinite(values).all(axis=1))[0, 0])
                raise DataError(
                    self.path,
                    f"{name} of grain {grain} is not finite at step {step}",
                    "finite values",
                    "lower the time step",
                )
        for name, values in frame.items():
            # The filter counts its steps from a chunk's smallest value: rounded values keep zero (at rest) zero.
            self._pending[name].append(np.round(values, self._decimals[name]))
        grains = self._file[GRAINS]
        if "active" in self._shared:
            grains["active/value"].resize(self._n_frames + 1, axis=0)
            grains["active/value"][self._n_frames] = active
        for name, value in (("step", step), ("time", time_s)):
            grains["position"][name].resize((self._n_frames + 1,))
            grains["position"][name][self._n_frames] = value
        self._n_frames += 1
        if len(self._pending["position"]) == CHUNK_FRAMES:  # a whole chunk at once: each is compressed once
            try:
                self._flush()
                self._file.flush()
            except (OSError, RuntimeError) as error:
                raise self._not_written(error) from None

    def _flush(self) -> None:
        for name, frames in self._pending.items():
            if frames:
                value = self._file[GRAINS][name]["value"]
                value.resize(self._n_frames, axis=0)
                value[self._n_frames - len(frames) :] = np.stack(frames)
                frames.clear()

    def finish(self, run: Mapping[str, Any]) -> None:
        """Completes the file with the facts of the run (all of schema.RUN_KEYS) and gives it its final name."""
        missing = [key for key in RUN_KEYS if key not in run]
        if missing:
            raise DataError(self.path, f"run facts without {missing}", f"all of {RUN_KEYS}", "pass them to finish()")
        try:
            self._flush()
            self._file["parameters"].attrs.update(run)
            creator = self._file["h5md"].create_group("creator")
            creator.attrs["name"], creator.attrs["version"] = run["creator"], run["creator_version"]
            self._file.close()
            os.replace(self._temporary, self.path)
        except (OSError, RuntimeError) as error:
            raise self._not_written(error) from None

    def _not_written(self, error: Exception) -> StorageError:
        return StorageError(self.path, " ".join(str(error).split()), "a folder that can be written to", REMEDY)

    def __enter__(self) -> "TrajectoryWriter":
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(
            AttributeError, OSError, RuntimeError
        ):  # never opened; or what is in memory finds no room: given up
            self._file.close()
        remove(self._temporary)

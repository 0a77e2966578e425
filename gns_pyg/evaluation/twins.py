"""The yardstick of chaos: how far two DEM runs drift apart that start a micrometre apart (`data_gen.twins`)."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError


@dataclass(frozen=True)
class Twins:
    """Distance between DEM twins of one case, from the roll-out's start on.

    Attributes:
        mean_m, std_m: (n_frames,) m, mean over pairs and their standard deviation, of the mean distance of
            corresponding grains.
        center_of_mass_max_m: largest distance of their centres of mass at any frame, m, mean over pairs; None in files
            that do not tell.
        angle_of_repose_deg: difference of their steady angles of repose, mean over pairs; None likewise, and in a scene
            that has none.
    """

    mean_m: np.ndarray
    std_m: np.ndarray
    center_of_mass_max_m: float | None = None
    angle_of_repose_deg: float | None = None


def twins_path(case: Path) -> Path:
    """Where the twins of a case are stored: twins_006.json beside case_006.h5."""
    return case.with_name(f"{case.stem.replace('case', 'twins')}.json")


def read_twins(case: Trajectory, times_s: np.ndarray) -> Twins | None:
    """The stored twins of a case at the frames `times_s` (n_frames,) s of a roll-out, linear between their own; None
    where there are none, or they start at another time.

    Raises:
        DataError: if the file cannot be read, or belongs to another run.
    """
    path = twins_path(case.path)
    if not path.is_file():
        return None
    remedy = "delete it, or make it again: python -m data_gen.twins"
    try:
        stored = json.loads(path.read_text())
        if stored["content_hash"] != case.content_hash():
            found, expected = f"twins of the run {stored['content_hash']}", f"twins of the run {case.content_hash()}"
            raise DataError(path, found, expected, remedy)
        known_s = np.array(stored["times_s"], np.float64)
        mean_m, std_m = (np.array(stored[f"{key}_distance_m"], np.float64) for key in ("mean", "std"))
        if abs(known_s[0] - times_s[0]) > 1e-6:
            return None
        told = []
        for key in ("center_of_mass_max_m", "angle_of_repose_deg"):
            pairs = [value for value in stored.get(key, []) if value is not None]
            told.append(float(np.mean(pairs)) if pairs else None)
        return Twins(np.interp(times_s, known_s, mean_m), np.interp(times_s, known_s, std_m), *told)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(path, f"{type(error).__name__}: {error}", "what data_gen.twins writes", remedy) from None


def horizon(error_m: np.ndarray, times_s: np.ndarray, twins: Twins) -> float:
    """Predictability horizon, s: how long after the start a distance stays below half of the twins' late one (at the
    last frame).

    Args:
        error_m: (n_frames,) m, of a roll-out or of the twins themselves.
        times_s: (n_frames,) s.
        twins: of the case.
    """
    beyond = np.flatnonzero(error_m >= 0.5 * twins.mean_m[-1])
    return float(times_s[beyond[0] if len(beyond) else -1] - times_s[0])

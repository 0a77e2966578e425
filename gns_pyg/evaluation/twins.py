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
    """

    mean_m: np.ndarray
    std_m: np.ndarray


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
        return Twins(np.interp(times_s, known_s, mean_m), np.interp(times_s, known_s, std_m))
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

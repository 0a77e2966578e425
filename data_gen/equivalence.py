"""Does a larger DEM time step show the same? `python -m data_gen.equivalence scene=hopper reference=data/hopper_1e-5`.

Compares cases with the same cases run at another time step, observable by observable, and puts the difference beside
the scatter between cases, which differ in nothing but their seed. Config: conf/equivalence.yaml.
"""

import logging
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from scipy.stats import wasserstein_distance

from data_gen.continuation import layout
from gns_pyg.config import require
from gns_pyg.data.datamodule import open_cases
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.errors import nanmean, positions
from gns_pyg.evaluation.flow import discharge_rate
from gns_pyg.evaluation.metrics import observe, write_json
from gns_pyg.evaluation.observables import finite_difference_velocity, from_frame, time_mean
from gns_pyg.evaluation.predict import start_frame
from gns_pyg.launch import launch
from gns_pyg.scene.scene import Scene

log = logging.getLogger(__name__)

LEAST_CASES = 3  # to tell scatter
COLUMNS = ("difference", "largest", "scatter")


def equivalence(cfg: DictConfig) -> dict[str, Any]:
    """Compares the cases that `cfg` names; prints a table and writes equivalence.json.

    Returns:
        `values`: observable -> {`difference`: mean over pairs of this minus the reference, `largest`: largest absolute
        one, `scatter`: standard deviation over cases}. `distances`: of curves, observable -> {`difference`: mean over
        pairs, `largest`, `scatter`: mean over pairs of different cases}.

    Raises:
        GnsError: for cases that do not exist or are of another scene, or fewer than three.
    """
    scene = Scene.from_config(cfg.scene)
    there = "a folder of cases at another time step, made with out=..."
    require(cfg.reference is not None, "reference", "null", there, "see docs/time_step.md")
    cases = {case.path.name: case for case in open_cases(scene, cfg.data.dir)}
    others = {case.path.name: case for case in open_cases(scene, cfg.reference)}
    enough = len(cases) >= LEAST_CASES
    require(enough, "data.dir", f"{len(cases)} case(s)", f"at least {LEAST_CASES}", "generate more")
    names = sorted(cases.keys() & others.keys())
    require(bool(names), "reference", "no case of data.dir", "some of the same cases", "generate them with out=...")
    ours = {name: observed(case, scene, cfg.start_s) for name, case in cases.items()}
    theirs = {name: observed(others[name], scene, cfg.start_s) for name in names}
    values, distances = {}, {}
    for key, first in ours[names[0]].items():
        if isinstance(first, float):
            off = np.array([ours[name][key] - theirs[name][key] for name in names])
            scatter = float(np.std([seen[key] for seen in ours.values()], ddof=1))
            values[key] = _row(off, scatter)
        else:
            off = np.array([_distance(key, ours[name][key], theirs[name][key]) for name in names])
            between = [_distance(key, a[key], b[key]) for a, b in combinations(ours.values(), 2)]
            distances[key] = _row(off, float(np.mean(between)))
    result = {
        "scene": scene.name,
        "dt_s": cases[names[0]].run["dt_s"],
        "reference_dt_s": others[names[0]].run["dt_s"],
        "pairs": names,
        "cases": len(cases),
        "values": values,
        "distances": distances,
    }
    write_json(Path(cfg.folder) / "equivalence.json", result)
    log.info("%s", table(result))
    return result


def observed(case: Trajectory, scene: Scene, start_s: float) -> dict[str, Any]:
    """What a run shows from `start_s` on: numbers, and arrays that are compared by a distance."""
    start = start_frame(case, start_s)
    pos, times_s = positions(case, start), case.times_s[start:]
    seen = observe(pos, times_s, case.radius, case.mass, scene)
    speed = np.linalg.norm(finite_difference_velocity(pos, times_s), axis=2)
    found: dict[str, Any] = {
        "center_of_mass_m": seen.center_of_mass_m,
        "speed_distribution_m_s": speed[np.isfinite(speed)],
        "mean_speed_m_s": nanmean(seen.mean_speed_m_s),
        "granular_temperature_m2_s2": nanmean(seen.granular_temperature_m2_s2),
        "mean_overlap_ratio": nanmean(seen.overlap_ratio),
        "coordination_number": nanmean(seen.coordination_number),
    }
    if seen.angle_of_repose_deg is not None:
        found["angle_of_repose_deg"] = time_mean(seen.angle_of_repose_deg[from_frame(times_s, scene) :])[0]
    if seen.discharged is not None:
        found["discharge_rate_kg_s"] = discharge_rate(seen.discharged, case.mass, times_s)
    return found


def _distance(key: str, a: np.ndarray, b: np.ndarray) -> float:
    """Curves: largest distance over frames. Distributions: the first Wasserstein distance."""
    if key == "center_of_mass_m":
        n = min(len(a), len(b))
        return float(np.linalg.norm(a[:n] - b[:n], axis=1).max())
    return float(wasserstein_distance(a, b))


def _row(off: np.ndarray, scatter: float) -> dict[str, float]:
    return {"difference": float(off.mean()), "largest": float(np.abs(off).max()), "scatter": scatter}


def table(result: dict[str, Any]) -> str:
    """Differences beside the scatter between cases."""
    heading = [f"step {result['dt_s']:.3g} s against {result['reference_dt_s']:.3g} s", *COLUMNS]
    rows = [(key, [row[c] for c in COLUMNS]) for kind in ("values", "distances") for key, row in result[kind].items()]
    return layout(heading, rows, "{:.4g}".format)


if __name__ == "__main__":
    launch("equivalence", equivalence)

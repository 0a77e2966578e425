"""What must a state hold? The DEM answers: `python -m data_gen.restart scene=hopper_small` (config: conf/restart.yaml).

Restarts the DEM from parts of stored frames, runs one frame, and compares it with the stored next one. What a restart
gets wrong is what a model of that state cannot see: an indication which `state` the scene should name, not a bound,
since a network may average over the unseen.

The full state's own error is what no stored frame holds, the load of the contacts' tangential springs, plus rounding
(`scene.dem.decimals`). The embedded cases keep positions to half a micrometre, velocities to 0.5 mm/s and spins to
0.05 rad/s. Half a micrometre is small beside the mean overlap (0.07 % of a diameter, 14 um, in the hopper), so forces
hardly change; the velocities' rounding moves a free grain by up to 5 um per axis in a frame of 10 ms, and a finite
difference is off by up to 0.1 mm/s. Measured, rounding adds at most 5 um to an error (docs/state.md). A coarser
file would not do: a settled bed whose positions are jittered by 0.3 mm jumps to 0.26 m/s, so nothing may move grains
by more than micrometres.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from data_gen.continuation import continue_dem, frame_at, layout, open_case, stored_state
from data_gen.initial import Start
from gns_pyg.config import require
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.baselines import FIRST_FRAME, trivial_errors
from gns_pyg.evaluation.errors import position_error, positions
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.launch import launch

log = logging.getLogger(__name__)

STATES = {  # the values of `requires.state`, smallest first -> what they hold
    "differences": "x, finite-difference velocity",
    "velocity": "x, v",
    "full": "x, v, angular velocity",
}
WITHIN = 1.25  # a state whose error is at most so many times the full one's is as good as full


def restart(cfg: DictConfig) -> dict[str, Any]:
    """Restarts the case that `cfg` names at `cfg.times_s` from every kind of state; prints and writes restart.json.

    Returns:
        `times_s`, and per requires.state the `position_error_m` at each of them (equation (13) of the paper, one frame
        later) and its `mean_position_error_m`; the same of the trivial predictors; `state`: the one that follows.

    Raises:
        GnsError: for a case or time that does not exist, Yade missing or failing.
    """
    trajectory, scene = open_case(cfg)
    given = OmegaConf.is_list(cfg.times_s) and len(cfg.times_s) > 0
    require(given, "times_s", cfg.times_s, "a list of times", "e.g. 'times_s=[0.1, 0.5]'")
    frames = [frame_at(trajectory, time_s, "times_s", first=1) for time_s in cfg.times_s]
    errors: dict[str, list[float]] = {state: [] for state in STATES}
    for frame in frames:
        truth = positions(trajectory, frame + 1, frame + 2)
        for state, found in errors.items():
            pos = continue_dem(trajectory, scene, partial_state(trajectory, frame, state), n_frames=2)
            found.append(float(position_error(pos[1:], truth)[0]))
    index = [frame + 1 - FIRST_FRAME for frame in frames]
    trivial = {name: error[index].tolist() for name, error in trivial_errors(trajectory, scene).items()}
    trivial = dict(sorted(trivial.items(), key=lambda item: np.mean(item[1])))
    means = _means(errors)
    result = {
        "scene": scene.name,
        "case": trajectory.path.stem,
        "times_s": trajectory.times_s[frames].tolist(),
        "frame_dt_s": scene.frame_dt_s,
        "position_error_m": errors,
        "mean_position_error_m": means,
        "trivial_position_error_m": trivial,
        "trivial_mean_position_error_m": _means(trivial),
        "state": sufficient(means),
    }
    write_json(Path(cfg.folder) / "restart.json", result)
    log.info("%s\n%s", trajectory.path, table(result))
    return result


def partial_state(trajectory: Trajectory, frame: int, state: str) -> Start:
    """What a model of `state` (a key of STATES) knows of a stored frame; grains whose spin it does not know stand."""
    full = stored_state(trajectory, frame)
    if state == "full":
        return full
    vel = full.vel
    if state == "differences":
        vel = (full.pos - trajectory.read("position", frame - 1, frame)[0]) / trajectory.frame_dt_s
    return replace(full, vel=vel, ang_vel=np.zeros_like(full.ang_vel))


def sufficient(mean_error: dict[str, float]) -> str:
    """The smallest state whose mean error, m, is within WITHIN times the full one's."""
    return next(state for state in STATES if mean_error[state] <= WITHIN * mean_error["full"])


def table(result: dict[str, Any]) -> str:
    """Errors per time and their mean, mm, of restarts and trivial predictors; then the state that follows."""
    errors, means = result["position_error_m"], result["mean_position_error_m"]
    trivial, trivial_means = result["trivial_position_error_m"], result["trivial_mean_position_error_m"]
    rows = [(f"DEM from {holds}", [*errors[state], means[state]]) for state, holds in STATES.items()]
    rows += [(f"trivial: {name}", [*error, trivial_means[name]]) for name, error in trivial.items()]
    heading = ["mean position error, mm, a frame after t =", *(f"{time_s:g} s" for time_s in result["times_s"]), "mean"]
    state = result["state"]
    verdict = f"requires.state={state} ({STATES[state]}): the smallest within {WITHIN:g} times the full state's error"
    return f"{layout(heading, rows)}\n{verdict}"


def _means(errors: dict[str, list[float]]) -> dict[str, float]:
    return {name: float(np.mean(error)) for name, error in errors.items()}


if __name__ == "__main__":
    launch("restart", restart)

"""What costs nothing to predict: trivial one-step predictors, and the climatology of the training cases.

A network that does not beat these has learned nothing; every error is reported beside them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import parameters
from gns_pyg.evaluation.errors import mean_present, nanmax, nanmean, position_error, positions
from gns_pyg.evaluation.observables import angle_of_repose, center_of_mass, from_frame, outflow
from gns_pyg.scene.free_flight import free_flight
from gns_pyg.scene.scene import Scene

FIRST_FRAME = 2  # the first frame that all trivial predictors can predict: some need the two frames before it


def trivial_errors(trajectory: Trajectory, scene: Scene) -> dict[str, np.ndarray]:
    """Mean one-step position error of every trivial predictor along a run.

    With x the position, v the instantaneous velocity and d = x(t) - x(t - dt) the last displacement:

    - `frozen`: x stays.
    - `last displacement repeated`: x + d.
    - `last displacement + free-flight acceleration`: x + d + a dt^2.
    - `instantaneous velocity, free flight`: x + v dt + a dt^2 / 2.

    The acceleration a is the scene's own free-flight law, gravity with the DEM's damping (of this case, where it
    varies). All predict the same grains: those present in the frame, the one before and the next.

    Returns:
        predictor name -> (n_frames - 2,), m: errors of frames 2, 3, ..., n_frames - 1.
    """
    pos, vel, dt_s = positions(trajectory), trajectory.read("velocity"), trajectory.frame_dt_s
    scene = replace(scene, damping=trajectory.scene["damping"])
    last, truth = pos[1:-1] - pos[:-2], pos[FIRST_FRAME:]
    now = np.where(np.isnan(last), np.nan, pos[1:-1])
    by_difference = _fly(now, last / dt_s, scene, dt_s)
    predicted = {
        "frozen": now,
        "last displacement repeated": now + last,
        "last displacement + free-flight acceleration": now + last + 2 * (by_difference - now - last),
        "instantaneous velocity, free flight": _fly(now, vel[1:-1], scene, dt_s),
    }
    return {name: position_error(guess, truth) for name, guess in predicted.items()}


def best_trivial(cases: Sequence[Mapping[str, np.ndarray]]) -> tuple[str, float]:
    """The trivial predictor with the smallest error: mean over frames, then over cases.

    Args:
        cases: per case predictor name -> (n,) m.

    Returns:
        (name, mean error, m).
    """
    means = {name: nanmean(np.array([nanmean(case[name]) for case in cases])) for name in cases[0]}
    best = min(means, key=lambda name: means[name])
    return best, means[best]


def _fly(pos: np.ndarray, vel: np.ndarray, scene: Scene, dt_s: float) -> np.ndarray:
    """Positions after `dt_s` of free flight; pos and vel (n_frames, n_grains, 3)."""
    flat_pos, flat_vel = (torch.from_numpy(np.ascontiguousarray(x.reshape(-1, 3))) for x in (pos, vel))
    return free_flight(flat_pos, flat_vel, scene, dt_s)[0].numpy().reshape(pos.shape)


@dataclass(frozen=True)
class Climatology:
    """Mean curves of the training cases: the forecast of someone who has seen the scene but not this case.

    Attributes:
        times_s: (n_frames,), s.
        center_of_mass_m: (n_frames, 3), m.
        angle_of_repose_deg: (n_frames,), degrees; None where the scene defines no angle of repose.
        outflow: (n_frames,), part of the grains at t = 0 that have left; None where the scene has no outlet.
    """

    times_s: np.ndarray
    center_of_mass_m: np.ndarray
    angle_of_repose_deg: np.ndarray | None
    outflow: np.ndarray | None = None

    @staticmethod
    def from_plain(values: Mapping[str, Any]) -> "Climatology":
        """Reads one stored as plain lists (`evaluation.metrics.strict(asdict(...))`); null is nan."""
        curves = {key: None if curve is None else np.array(curve, np.float64) for key, curve in values.items()}
        return Climatology(**curves)  # type: ignore[arg-type]

    def center_of_mass_at(self, times_s: np.ndarray) -> np.ndarray:
        """The mean curve at `times_s` (n,), (n, 3), m; linear between frames, held beyond the last."""
        return _at(times_s, self.times_s, self.center_of_mass_m)

    def center_of_mass_error_m(self, times_s: np.ndarray, truth: np.ndarray) -> float:
        """Largest distance (3D, over frames) between the mean curve and a case's centre of mass `truth` (n, 3), m."""
        return nanmax(np.linalg.norm(self.center_of_mass_at(times_s) - truth, axis=1))

    def outflow_at(self, times_s: np.ndarray) -> np.ndarray:
        """The part of the grains there at times_s[0] that have left by `times_s` (n,), (n,); nan without an outlet."""
        if self.outflow is None:
            return np.full(len(times_s), np.nan)
        left = _at(times_s, self.times_s, self.outflow[:, None])[:, 0]
        with np.errstate(invalid="ignore"):
            return (left - left[0]) / (1 - left[0])

    def mean_angle_of_repose_deg(self, scene: Scene, until_s: float = math.inf) -> float:
        """The mean angle of repose of the training cases over the frames from `from_s` to `until_s`, where what it is
        held against ends; nan if none is defined."""
        if self.angle_of_repose_deg is None:
            return float("nan")
        stop = np.searchsorted(self.times_s, until_s + 1e-9)
        return nanmean(self.angle_of_repose_deg[from_frame(self.times_s, scene) : stop])


def climatology(trajectories: Sequence[Trajectory], scene: Scene) -> Climatology:
    """Averages the training cases' curves, aligned by time (linear between frames) on the first case's frames. Where
    parameters vary: of the cases that have the scene's own, as someone would who knows the material, if there are any.
    """
    trajectories = of_material(trajectories, scene) or trajectories
    times_s = trajectories[0].times_s
    centers, angles, left = [], [], []
    for trajectory in trajectories:
        pos = positions(trajectory)
        centers.append(_at(times_s, trajectory.times_s, center_of_mass(pos, trajectory.mass)))
        if scene.angle_of_repose is not None:
            angles.append(_at(times_s, trajectory.times_s, angle_of_repose(pos, scene)[:, None])[:, 0])
        if scene.outlet is not None:
            left.append(_at(times_s, trajectory.times_s, outflow(pos)[:, None])[:, 0])
    mean_angle = np.array([nanmean(frame) for frame in np.array(angles).T]) if angles else None
    mean_left = mean_present(np.array(left), axis=0) if left else None
    return Climatology(times_s, mean_present(np.array(centers), axis=0), mean_angle, mean_left)


def of_material(trajectories: Sequence[Trajectory], scene: Scene) -> list[Trajectory]:
    """The cases that have the scene's own parameters, where these vary from case to case."""
    return [case for case in trajectories if parameters(case) == list(scene.parameters.values())]


def _at(times_s: np.ndarray, known_s: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """`curve` (n_known, k) at `times_s` (n,): (n, k)."""
    return np.stack([np.interp(times_s, known_s, column) for column in curve.T], axis=1)

"""Many roll-outs from one start, a micrometre apart: what is certain about a chaotic flow is its mean and spread."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scoringrules

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.evaluation.errors import nanmean, position_error, positions
from gns_pyg.evaluation.metrics import Observables, observe
from gns_pyg.evaluation.observables import escaped_grains
from gns_pyg.evaluation.predict import initial_state, perturbed, roll_out_from
from gns_pyg.scene.scene import Scene
from gns_pyg.scene.symmetry import up_direction

SHIFT_M = 1e-6  # standard deviation of every coordinate's shift, as of the DEM twins


@dataclass(frozen=True)
class Ensemble:
    """Roll-outs of one case beside its DEM run.

    Attributes:
        times_s: (n_frames,) s.
        members: observable -> (n_members, n_frames), SI, nan where it cannot be had.
        dem: observable -> (n_frames,), the same of the DEM run.
        error_m: (n_members, n_frames) m, position error of every member.
        escaped: most grains outside at any frame, over members.
        seconds_per_simulated_second: wall clock of all members together.
    """

    times_s: np.ndarray
    members: Mapping[str, np.ndarray]
    dem: Mapping[str, np.ndarray]
    error_m: np.ndarray
    escaped: int
    seconds_per_simulated_second: float

    def crps(self) -> dict[str, float]:
        """Continuous ranked probability score of every observable, mean over frames where it can be had, in its own
        unit: 0 is perfect, and of a single member it is the absolute error (Gneiting and Raftery 2007)."""
        scores = {}
        for name, curves in self.members.items():
            known = np.isfinite(curves).all(axis=0) & np.isfinite(self.dem[name])
            scores[name] = nanmean(scoringrules.crps_ensemble(self.dem[name][known], curves[:, known].T))
        return scores

    def plain(self) -> dict[str, object]:
        """Mean and spread (standard deviation over members) of every observable, DEM's own, and the scores."""
        observables = {
            name: {"mean": curves.mean(axis=0), "std": curves.std(axis=0, ddof=1), "dem": self.dem[name]}
            for name, curves in self.members.items()
        }
        return {
            "members": len(self.error_m),
            "shift_m": SHIFT_M,
            "times_s": self.times_s,
            "observables": observables,
            "crps": self.crps(),
            "rollout_error_m": {"mean": self.error_m.mean(axis=0), "std": self.error_m.std(axis=0, ddof=1)},
            "escaped_grains": self.escaped,
            "seconds_per_simulated_second": self.seconds_per_simulated_second,
        }


def roll_out_ensemble(simulator: Simulator, case: Trajectory, start: int, n_members: int) -> Ensemble:
    """Rolls out `n_members` copies of a case's frame `start`, a micrometre apart, as one batch.

    Raises:
        NumericalError: if a member diverges; names step, field and grain.
    """
    scene, times_s = simulator.scene, case.times_s[start:]
    state = perturbed(initial_state(simulator, case, start), n_members, SHIFT_M, scene.seed)
    pos, seconds = roll_out_from(simulator, case, start, state)
    dem_pos = positions(case, start)
    of_case = (times_s, case.radius, case.mass, scene)
    seen = [curves(observe(member, *of_case), scene) for member in pos]
    return Ensemble(
        times_s,
        {name: np.array([member[name] for member in seen]) for name in seen[0]},
        curves(observe(dem_pos, *of_case), scene),
        np.array([position_error(member, dem_pos) for member in pos]),
        max(int(escaped_grains(member, times_s, scene).max()) for member in pos),
        seconds,
    )


def curves(seen: Observables, scene: Scene) -> dict[str, np.ndarray]:
    """The observables that are one number per frame, (n_frames,) each; those of steps repeat their last."""
    found = {
        "center_of_mass_height_m": seen.center_of_mass_m @ up_direction(scene),
        "angle_of_repose_deg": seen.angle_of_repose_deg,
        "mean_overlap_ratio": seen.overlap_ratio,
        "coordination_number": seen.coordination_number,
        "mean_speed_m_s": np.append(seen.mean_speed_m_s, seen.mean_speed_m_s[-1:]),
        "granular_temperature_m2_s2": np.append(seen.granular_temperature_m2_s2, seen.granular_temperature_m2_s2[-1:]),
        "outflow": seen.outflow,
        "discharged": seen.discharged,
        "mixing_index": seen.mixing_index,
    }
    return {name: curve for name, curve in found.items() if curve is not None}

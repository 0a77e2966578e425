"""From roll-outs of the test cases to a flat dict of metrics, each key with its unit, and the curves behind them."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.errors import DataError, NumericalError
from gns_pyg.evaluation.baselines import FIRST_FRAME, Climatology, best_trivial, trivial_errors
from gns_pyg.evaluation.contacts import coordination_number, means, overlap_ratios
from gns_pyg.evaluation.errors import nanmax, nanmean, position_error, positions
from gns_pyg.evaluation.flow import discharge_rate, discharged, emptying_time, mixing_index
from gns_pyg.evaluation.observables import (
    angle_of_repose,
    center_of_mass,
    escaped_grains,
    from_frame,
    granular_temperature,
    mean_speed,
    outflow,
    time_mean,
)
from gns_pyg.evaluation.twins import Twins, horizon, read_twins
from gns_pyg.files import whole
from gns_pyg.scene.scene import Scene

LATE_S = 1.0  # from here on a roll-out's error is compared with the twins'


@dataclass(frozen=True)
class CaseResult:
    """A test case, what DEM says and what was predicted. Build it with `case_result`.

    Attributes:
        name: the case's file name without ending.
        times_s: (n_frames,) s; frame 0 is the state that the roll-out starts from.
        dem_pos, pos: grain centres by DEM and by roll-out, m, (n_frames, n_grains, 3), nan where a grain is absent;
            frame 0 is the same in both.
        radius, mass: (n_grains,), m and kg.
        one_step_times_s: (n,) s, times of the frames predicted in one step from DEM's own state, along the whole run.
        one_step_error_m: (n,) m, the model's mean position error there.
        trivial_error_m: name of a trivial predictor -> (n,) m, its error at the same frames.
        seconds_per_simulated_second: wall clock of the roll-out.
        twins: distance of DEM twins, or None where none are stored with the case.
        yade_seconds_per_simulated_second, yade_cores, yade_dt_s: the DEM run's time, cores and time step. On one core
            its processor time is taken: on an idle machine the wall clock, and no longer on a busy one.
    """

    name: str
    times_s: np.ndarray
    dem_pos: np.ndarray
    pos: np.ndarray
    radius: np.ndarray
    mass: np.ndarray
    one_step_times_s: np.ndarray
    one_step_error_m: np.ndarray
    trivial_error_m: Mapping[str, np.ndarray]
    seconds_per_simulated_second: float
    yade_seconds_per_simulated_second: float
    yade_cores: int
    yade_dt_s: float
    twins: Twins | None = None


def case_result(
    trajectory: Trajectory,
    scene: Scene,
    pos: np.ndarray,
    start_frame: int,
    one_step_error_m: np.ndarray,
    one_step_first_frame: int,
    seconds_per_simulated_second: float,
) -> CaseResult:
    """Puts a roll-out beside the DEM run that it starts from.

    Args:
        trajectory: the test case.
        scene: its scene.
        pos: the roll-out, m, (n, n_grains, 3), nan where a grain is absent; pos[0] is the DEM's frame `start_frame`.
        start_frame: frame of the trajectory that the roll-out starts from.
        one_step_error_m: (n,) m, the model's mean one-step error at frames `one_step_first_frame`, ... in a row.
        one_step_first_frame: the first frame predicted in one step.
        seconds_per_simulated_second: wall clock of the roll-out over the time it simulated.

    Raises:
        DataError: if sizes do not fit the trajectory.
        NumericalError: if a predicted position is not finite.
    """
    stop = start_frame + len(pos)
    if pos.shape[1:] != (trajectory.n_grains, 3) or not 0 <= start_frame < stop <= trajectory.n_frames:
        raise DataError(
            trajectory.path,
            f"roll-out {pos.shape} from frame {start_frame} beside {trajectory.n_frames} frames",
            f"(up to {trajectory.n_frames - start_frame}, {trajectory.n_grains}, 3)",
            "roll out the same case, no further than the DEM run goes",
        )
    sound = np.isfinite(pos).all(axis=2) | (trajectory.has_active & np.isnan(pos).all(axis=2))
    if not sound.all():
        frame = int(np.argwhere(~sound.all(axis=1))[0, 0])
        raise NumericalError(
            f"roll-out of {trajectory.path.name}",
            f"positions that are not finite from frame {start_frame + frame} on",
            "finite positions",
            "the model is unstable here: train longer, or on its own roll-outs",
        )
    skipped = max(FIRST_FRAME - one_step_first_frame, 0)
    first, n = one_step_first_frame + skipped, len(one_step_error_m) - skipped
    if n < 1 or first + n > trajectory.n_frames:
        raise DataError(
            trajectory.path,
            f"{len(one_step_error_m)} one-step errors from frame {one_step_first_frame} on",
            f"errors of frames {FIRST_FRAME} to {trajectory.n_frames - 1}, or some of them in a row",
            "use a longer run, or evaluate one step along this one",
        )
    trivial = trivial_errors(trajectory, scene)
    run, span_s = trajectory.run, trajectory.times_s[-1] - trajectory.times_s[0]
    return CaseResult(
        name=trajectory.path.stem,
        times_s=trajectory.times_s[start_frame:stop],
        dem_pos=positions(trajectory, start_frame, stop),
        pos=np.asarray(pos, np.float64),
        radius=trajectory.radius,
        mass=trajectory.mass,
        one_step_times_s=trajectory.times_s[first : first + n],
        one_step_error_m=np.asarray(one_step_error_m, np.float64)[skipped:],
        trivial_error_m={key: error[first - FIRST_FRAME :][:n] for key, error in trivial.items()},
        seconds_per_simulated_second=seconds_per_simulated_second,
        yade_seconds_per_simulated_second=dem_seconds(run) / span_s,
        yade_cores=int(run["cores"]),
        yade_dt_s=float(run["dt_s"]),
        twins=read_twins(trajectory, trajectory.times_s[start_frame:stop]),
    )


def dem_seconds(run: Mapping[str, Any]) -> float:
    """What a DEM run took, s, from its stored facts (see `CaseResult`)."""
    return float(run.get("cpu_time_s", run["wall_clock_s"]) if run["cores"] == 1 else run["wall_clock_s"])


@dataclass(frozen=True)
class Observables:
    """Curves of one set of positions; all (n_frames,) unless said otherwise, nan where there is no grain.

    Attributes:
        center_of_mass_m: (n_frames, 3), m.
        angle_of_repose_deg: degrees, or None where the scene defines none.
        overlap_ratios: of every touching pair, part of a diameter, frame by frame.
        coordination_number: mean number of grains that a grain touches.
        mean_speed_m_s, granular_temperature_m2_s2: (n_frames - 1,), of the step that leaves the frame.
        outflow: part of the grains at the start that have left, or None where the scene has no outlet.
        discharged: part of the mass that has passed the mouth, or None where the scene has none.
        mixing_index: Lacey's, or None where the scene is no drum.
    """

    center_of_mass_m: np.ndarray
    angle_of_repose_deg: np.ndarray | None
    overlap_ratios: list[np.ndarray]
    coordination_number: np.ndarray
    mean_speed_m_s: np.ndarray
    granular_temperature_m2_s2: np.ndarray
    outflow: np.ndarray | None
    discharged: np.ndarray | None
    mixing_index: np.ndarray | None

    @property
    def overlap_ratio(self) -> np.ndarray:
        """Mean overlap of touching pairs, (n_frames,); 0 where none touch."""
        return means(self.overlap_ratios)


@dataclass(frozen=True)
class CaseEvaluation:
    """A case's curves, over the roll-out's frames, and its own metrics (the keys of `Evaluation.metrics`).

    Attributes:
        result: the case.
        error_m, frozen_error_m: (n_frames,) m, position error of the roll-out and of grains frozen at its start.
        dem, model: what is observed in DEM and in the roll-out.
        climatology_center_of_mass_m: (n_frames, 3) m, the training cases' mean.
        escaped_grains: (n_frames,) int, grains of the roll-out that are outside.
        metrics: this case's own figures.
    """

    result: CaseResult
    error_m: np.ndarray
    frozen_error_m: np.ndarray
    dem: Observables
    model: Observables
    climatology_center_of_mass_m: np.ndarray
    escaped_grains: np.ndarray
    metrics: dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """All test cases.

    Attributes:
        metrics: the mean over test cases, flat; nan where a figure cannot be had (null in JSON).
        cases: per case curves and metrics.
        trivial_name: the best trivial one-step predictor of the test set.
        climatology: the training cases' mean curves.
    """

    metrics: dict[str, Any]
    cases: list[CaseEvaluation]
    trivial_name: str
    climatology: Climatology

    @property
    def per_case(self) -> list[dict[str, Any]]:
        """One dict per test case: `case` (its name) and its own metrics."""
        return [{"case": case.result.name, **case.metrics} for case in self.cases]


def evaluate_cases(results: Sequence[CaseResult], climatology: Climatology, scene: Scene) -> Evaluation:
    """Evaluates the roll-outs of the test cases.

    The metrics, each the mean over test cases unless said otherwise:

    - `test/one_step_error_m`: mean over the run; `test/one_step_error_at_start_m`: of the first step of the roll-out;
      `test/one_step_error_trivial_m` and `test/one_step_error_trivial_name`: the trivial predictor that is best over
      all test cases, at the same frames.
    - `test/rollout_error_final_m`: position error at the last frame, `test/rollout_error_final_frozen_m`: of grains
      frozen at the roll-out's start.
    - `test/rollout_error_final_twin_m`, `test/rollout_error_over_twin`: the distance of DEM twins at the last frame,
      and the roll-out's error over it, mean over frames from 1 s on; `test/horizon_s`, `test/horizon_twin_s`: see
      `twins.horizon`. Absent unless every case has its twins.
    - `test/center_of_mass_error_max_m`: largest 3D distance over frames of the roll-out; `..._frozen_max_m`,
      `..._climatology_max_m`, `..._twin_max_m`: the same for the start's centre of mass, the training cases' mean curve
      and DEM twins (absent unless every case's twins tell).
    - `test/angle_of_repose_deg`, `test/angle_of_repose_dem_deg`: time mean from `from_s` on; their
      `_standard_error_deg`: of the mean over cases, from the cases' own (block averaged) errors;
      `test/angle_of_repose_error_deg`: absolute difference per case; `..._climatology_deg`, `..._twin_deg`: of the
      training cases' mean and of DEM twins against DEM. Absent where the scene defines no angle of repose.
    - `test/outflow_final`, `test/outflow_dem_final`: part of the grains at the start that have left at the last frame;
      `test/outflow_error_max`, `..._climatology_max`: largest difference from DEM over frames, of the roll-out and of
      the training cases' mean. Absent where the scene has no outlet.
    - `test/escaped_grains`: most at any frame, summed over cases.
    - `test/mean_overlap_ratio`, `..._dem`: mean over frames after the start, part of a diameter;
      `test/overlap_ratio_999`: 99.9th percentile over pairs and frames.
    - `test/mean_speed_m_s`, `test/granular_temperature_m2_s2`, `test/coordination_number`, each with `..._dem`: mean
      over frames.
    - `test/discharge_rate_kg_s`, `test/emptying_time_s`, each with `..._dem`: see `flow`; absent without a mouth.
    - `test/mixing_index_final`, `..._dem`: at the last frame; absent where the scene is no drum.
    - `speed/...`: wall clock per simulated second of roll-out and of Yade, with Yade's cores and time step.

    Raises:
        DataError: if there is no test case.
    """
    if not results:
        raise DataError("test cases", "none", "at least one", "raise data.test_fraction")
    trivial_name, trivial = best_trivial([result.trivial_error_m for result in results])
    cases = [_evaluate_case(result, trivial_name, climatology, scene) for result in results]
    metrics: dict[str, Any] = {}
    for key in (key for key in cases[0].metrics if all(key in case.metrics for case in cases)):
        values = np.array([case.metrics[key] for case in cases], np.float64)
        if key == "test/escaped_grains":
            metrics[key] = int(values.sum())
        elif key == "speed/yade_cores":
            metrics[key] = int(values.max())
        elif key.endswith("_standard_error_deg"):
            metrics[key] = float(np.sqrt((values**2).sum()) / len(values))
        else:
            metrics[key] = nanmean(values)
    metrics["test/one_step_error_trivial_m"] = trivial
    metrics["test/one_step_error_trivial_name"] = trivial_name
    return Evaluation(metrics, cases, trivial_name, climatology)


def _evaluate_case(result: CaseResult, trivial_name: str, climatology: Climatology, scene: Scene) -> CaseEvaluation:
    error = position_error(result.pos, result.dem_pos)
    frozen = position_error(result.dem_pos[:1], result.dem_pos)
    run = (result.times_s, result.radius, result.mass, scene)
    dem, model = (observe(pos, *run) for pos in (result.dem_pos, result.pos))
    expected = climatology.center_of_mass_at(result.times_s)
    escaped = escaped_grains(result.pos, result.times_s, scene)
    after_start = result.one_step_times_s > result.times_s[0] + 1e-9
    center = dem.center_of_mass_m
    metrics: dict[str, Any] = {
        "test/one_step_error_m": nanmean(result.one_step_error_m),
        "test/one_step_error_at_start_m": next(iter(result.one_step_error_m[after_start].tolist()), float("nan")),
        "test/one_step_error_trivial_m": nanmean(result.trivial_error_m[trivial_name]),
        "test/rollout_error_final_m": float(error[-1]),
        "test/rollout_error_final_frozen_m": float(frozen[-1]),
        "test/center_of_mass_error_max_m": _largest_distance(model.center_of_mass_m, center),
        "test/center_of_mass_error_frozen_max_m": _largest_distance(center[:1], center),
        "test/center_of_mass_error_climatology_max_m": climatology.center_of_mass_error_m(result.times_s, center),
    }
    if result.twins is not None:
        late = result.times_s >= LATE_S - 1e-9
        metrics |= {
            "test/rollout_error_final_twin_m": float(result.twins.mean_m[-1]),
            "test/rollout_error_over_twin": nanmean(error[late] / result.twins.mean_m[late]),
            "test/horizon_s": horizon(error, result.times_s, result.twins),
            "test/horizon_twin_s": horizon(result.twins.mean_m, result.times_s, result.twins),
        }
        if result.twins.center_of_mass_max_m is not None:
            metrics["test/center_of_mass_error_twin_max_m"] = result.twins.center_of_mass_max_m
        if result.twins.angle_of_repose_deg is not None:
            metrics["test/angle_of_repose_error_twin_deg"] = result.twins.angle_of_repose_deg
    if dem.angle_of_repose_deg is not None and model.angle_of_repose_deg is not None:
        steady = slice(from_frame(result.times_s, scene), None)
        angle, angle_error = time_mean(model.angle_of_repose_deg[steady])
        dem_angle, dem_angle_error = time_mean(dem.angle_of_repose_deg[steady])
        expected_angle = climatology.mean_angle_of_repose_deg(scene, result.times_s[-1])
        metrics |= {
            "test/angle_of_repose_deg": angle,
            "test/angle_of_repose_standard_error_deg": angle_error,
            "test/angle_of_repose_dem_deg": dem_angle,
            "test/angle_of_repose_dem_standard_error_deg": dem_angle_error,
            "test/angle_of_repose_error_deg": abs(angle - dem_angle),
            "test/angle_of_repose_error_climatology_deg": abs(expected_angle - dem_angle),
        }
    if dem.outflow is not None and model.outflow is not None:
        expected_outflow = climatology.outflow_at(result.times_s)
        metrics |= {
            "test/outflow_final": float(model.outflow[-1]),
            "test/outflow_dem_final": float(dem.outflow[-1]),
            "test/outflow_error_max": nanmax(np.abs(model.outflow - dem.outflow)),
            "test/outflow_error_climatology_max": nanmax(np.abs(expected_outflow - dem.outflow)),
        }
    for suffix, seen in (("", model), ("_dem", dem)):
        every = np.concatenate(seen.overlap_ratios[1:])
        metrics |= {
            f"test/mean_overlap_ratio{suffix}": nanmean(seen.overlap_ratio[1:]),
            f"test/overlap_ratio_999{suffix}": float(np.quantile(every, 0.999)) if len(every) else 0.0,
            f"test/coordination_number{suffix}": nanmean(seen.coordination_number[1:]),
            f"test/mean_speed_m_s{suffix}": nanmean(seen.mean_speed_m_s),
            f"test/granular_temperature_m2_s2{suffix}": nanmean(seen.granular_temperature_m2_s2),
        }
        if seen.discharged is not None:
            metrics |= {
                f"test/discharge_rate_kg_s{suffix}": discharge_rate(seen.discharged, result.mass, result.times_s),
                f"test/emptying_time_s{suffix}": emptying_time(seen.discharged, result.times_s),
            }
        if seen.mixing_index is not None:
            metrics[f"test/mixing_index_final{suffix}"] = float(seen.mixing_index[-1])
    metrics |= {
        "test/escaped_grains": int(escaped.max()),
        "speed/seconds_per_simulated_second": float(result.seconds_per_simulated_second),
        "speed/yade_seconds_per_simulated_second": result.yade_seconds_per_simulated_second,
        "speed/yade_cores": result.yade_cores,
        "speed/yade_dt_s": result.yade_dt_s,
    }
    return CaseEvaluation(result, error, frozen, dem, model, expected, escaped, metrics)


def observe(pos: np.ndarray, times_s: np.ndarray, radius: np.ndarray, mass: np.ndarray, scene: Scene) -> Observables:
    """What positions (n_frames, n_grains, 3), m, show, be they DEM's or a roll-out's."""
    ratios = overlap_ratios(pos, radius)
    drum = scene.angle_of_repose is not None and scene.angle_of_repose.kind == "plane"
    return Observables(
        center_of_mass_m=center_of_mass(pos, mass),
        angle_of_repose_deg=None if scene.angle_of_repose is None else angle_of_repose(pos, scene),
        overlap_ratios=ratios,
        coordination_number=coordination_number(ratios, pos),
        mean_speed_m_s=mean_speed(pos, times_s),
        granular_temperature_m2_s2=granular_temperature(pos, times_s, radius),
        outflow=None if scene.outlet is None else outflow(pos),
        discharged=None if scene.mouth_height_m is None else discharged(pos, mass, scene),
        mixing_index=mixing_index(pos, scene) if drum else None,
    )


def _largest_distance(curve: np.ndarray, truth: np.ndarray) -> float:
    return nanmax(np.linalg.norm(curve - truth, axis=1))


def write_json(path: str | Path, metrics: Any) -> None:
    """Writes strict JSON (nan and infinity become null) under a temporary name, then renames it to `path`."""
    with whole(path) as temporary:
        temporary.write_text(json.dumps(strict(metrics), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def strict(value: Any) -> Any:
    """`value` as plain JSON values; nan and infinity become None."""
    if isinstance(value, Mapping):
        return {str(key): strict(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return strict(value.tolist())
    if isinstance(value, list | tuple):
        return [strict(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value

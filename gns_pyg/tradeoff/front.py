"""From rows to answers: who is beaten by nobody, which DEM step shows the same, when a network pays, what to run."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gns_pyg.config import require
from gns_pyg.tradeoff.axes import AXES

Row = Mapping[str, Any]
RUNS = ("trained", "without_training", "shipped", "yade")  # what a person can run
OBSERVED = ("center_of_mass_error_m", "angle_of_repose_error_deg")  # what the front and the choice look at
OBSERVABLES = (*OBSERVED, "granular_temperature_error", "overlap_error", "escaped_grains")


def error(row: Row, axis: str) -> float:
    """Mean over cases; infinite where the row does not tell."""
    value = row["axes"].get(axis, {}).get("mean")
    return math.inf if value is None else value


def seconds(row: Row) -> float:
    """Processor seconds per simulated second; infinite where it is not timed."""
    value = (row.get("time") or {}).get("cpu_s_per_simulated_s")
    return math.inf if value is None else value


def runnable(rows: Sequence[Row]) -> list[Row]:
    """The rows that can be run, did not fail, and are timed."""
    return [row for row in rows if row["kind"] in RUNS and row["error"] is None and math.isfinite(seconds(row))]


def front(rows: Sequence[Row], axes: Sequence[str] = OBSERVED) -> list[Row]:
    """The runnable rows that no other one beats: as fast and as accurate on all `axes`, better in one. By time."""
    goals = [(row, (seconds(row), *(error(row, axis) for axis in axes))) for row in runnable(rows)]
    best = [row for row, mine in goals if not any(_beats(other, mine) for _, other in goals)]
    return sorted(best, key=seconds)


def _beats(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one != other and all(a <= b for a, b in zip(one, other, strict=True))


def yardstick(rows: Sequence[Row], kind: str) -> Row | None:
    """The row of that kind, if there is one."""
    return next((row for row in rows if row["kind"] == kind and row["error"] is None), None)


def scatter(rows: Sequence[Row], axes: Sequence[str]) -> dict[str, float]:
    """Axis -> the largest difference between two DEM seeds; what a row that is as near as that cannot be told from.
    Empty without a row of seeds."""
    seeds = yardstick(rows, "seeds")
    return {} if seeds is None else {axis: seeds["axes"][axis]["most"] for axis in axes if axis in seeds["axes"]}


def within_scatter(row: Row, rows: Sequence[Row], axes: Sequence[str] = OBSERVABLES) -> bool:
    """Whether a row's mean error is, on all `axes`, within what DEM seeds differ by: nobody can tell it from DEM by one
    run."""
    known = scatter(rows, axes)
    return bool(known) and all(error(row, axis) <= limit for axis, limit in known.items())


def best_network(rows: Sequence[Row]) -> Row | None:
    """The fastest network whose centre of mass and angle of repose are within what DEM seeds differ by."""
    networks = [row for row in runnable(rows) if row["kind"] != "yade" and within_scatter(row, rows, OBSERVED)]
    return min(networks, key=seconds, default=None)


def equivalent_yade(rows: Sequence[Row]) -> Row | None:
    """Yade at the largest step up to which, step after step, the observables stay within the scatter between seeds."""
    steps = [row for row in rows if row["kind"] == "yade"]
    found = None
    for row in sorted(steps, key=lambda row: row.get("dt_s") or math.inf):
        if row["error"] is not None or not within_scatter(row, rows):
            break
        found = row
    return found


def break_even(row: Row, rows: Sequence[Row], cost: Mapping[str, float]) -> float | None:
    """After how many roll-outs of `cost["simulated_s"]` a network has paid back what Yade took for its training cases
    and what its training took; inf where it is no faster than Yade at its equivalent step, None where one of the
    times is not known or no Yade step is equivalent.

    Args:
        row: of a network.
        rows: the table.
        cost: `cases_s`: Yade's processor seconds for the training cases; `simulated_s`: of a roll-out.
    """
    yade = equivalent_yade(rows)
    if yade is None:
        return None
    if not (math.isfinite(seconds(yade)) and math.isfinite(seconds(row))):
        return None
    saved_s = (seconds(yade) - seconds(row)) * cost["simulated_s"]
    if saved_s <= 0:
        return math.inf
    trained_s = row.get("training_cpu_s")
    return None if trained_s is None else float(math.ceil((cost["cases_s"] + trained_s) / saved_s))


def choose(rows: Sequence[Row], simulated_s: float, max_seconds: float | None, most: Mapping[str, float]) -> Row | None:
    """What to run.

    Args:
        rows: the table of a scene.
        simulated_s: length of the roll-out wanted.
        max_seconds: most processor seconds for it; None: no limit.
        most: axis -> largest mean error, SI.

    Returns:
        With limits on errors: the fastest row within all limits. Without: the most accurate one within the time, by
        the largest of its errors in centre of mass and angle of repose over what DEM seeds differ by; among rows within
        that scatter, which nobody can tell apart, the fastest. None if no row is within the limits.

    Raises:
        ConfigError: without any limit, or for an axis that does not exist.
    """
    wanted = "max_seconds=... or max_<axis>=..."
    require(bool(most) or max_seconds is not None, "recommend", "no limit", wanted, f"axes: {', '.join(AXES)}")
    for axis in most:
        require(axis in AXES, f"max_{axis}", "no axis", f"one of {', '.join(AXES)}", "correct the name")
    allowed = [
        row
        for row in runnable(rows)
        if (max_seconds is None or seconds(row) * simulated_s <= max_seconds)
        and all(error(row, axis) <= limit for axis, limit in most.items())
    ]
    if not allowed:
        return None
    return min(allowed, key=seconds if most else lambda row: (max(1.0, score(row, rows)), seconds(row)))


def score(row: Row, rows: Sequence[Row]) -> float:
    """The larger of a row's errors in centre of mass and angle of repose, over what DEM seeds differ by."""
    known = scatter(rows, OBSERVED)
    return max((error(row, axis) / limit for axis, limit in known.items()), default=error(row, OBSERVED[0]))

"""The axes of accuracy: what every row is held against, one figure per unseen case."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gns_pyg.evaluation.metrics import strict


@dataclass(frozen=True)
class Axis:
    """One figure; less is better.

    Attributes:
        title: in words, with the unit that `factor` takes it to.
        factor: from the SI value to the unit of the title.
        of: a case's metrics (see `evaluation.metrics.evaluate_cases`) -> the figure; nan where it is not told.
    """

    title: str
    factor: float
    of: Callable[[Mapping[str, Any]], float]


def _get(case: Mapping[str, Any], key: str) -> float:
    value = case.get(f"test/{key}")
    return math.nan if value is None else float(value)


def _off(key: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda case: abs(_get(case, key) - _get(case, f"{key}_dem"))


def _relative(key: str) -> Callable[[Mapping[str, Any]], float]:
    return lambda case: abs(_get(case, key) / _get(case, f"{key}_dem") - 1)


AXES = {
    "one_step_error_m": Axis("one-step error, mm", 1e3, lambda case: _get(case, "one_step_error_m")),
    "rollout_error_over_twin": Axis(
        "roll-out error over the twins'", 1.0, lambda case: _get(case, "rollout_error_over_twin")
    ),
    "center_of_mass_error_m": Axis("centre of mass, mm", 1e3, lambda case: _get(case, "center_of_mass_error_max_m")),
    "angle_of_repose_error_deg": Axis(
        "angle of repose, degrees", 1.0, lambda case: _get(case, "angle_of_repose_error_deg")
    ),
    "granular_temperature_error": Axis("granular temperature, %", 100.0, _relative("granular_temperature_m2_s2")),
    "overlap_error": Axis("mean overlap, % of a diameter", 100.0, _off("mean_overlap_ratio")),
    "escaped_grains": Axis("escaped grains", 1.0, lambda case: _get(case, "escaped_grains")),
}
CLIMATOLOGY = {  # what the training cases' mean curves tell of these
    "center_of_mass_error_m": "center_of_mass_error_climatology_max_m",
    "angle_of_repose_error_deg": "angle_of_repose_error_climatology_deg",
}


def axes_of(row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Axis -> `mean` over cases, `least` and `most` of any, `cases`; an axis that the row does not tell is left out."""
    found = {}
    for name, axis in AXES.items():
        values = _values(row, name, axis)
        values = [value for value in values if math.isfinite(value)]
        if values:
            found[name] = {
                "mean": sum(values) / len(values),
                "least": min(values),
                "most": max(values),
                "cases": values,
            }
    return strict(found)


def _values(row: Mapping[str, Any], name: str, axis: Axis) -> Sequence[float]:
    cases = row.get("cases") or []
    match row["kind"]:
        case "climatology":
            return [_get(case, CLIMATOLOGY[name]) for case in cases] if name in CLIMATOLOGY else []
        case "trivial":
            return [_get(case, "one_step_error_trivial_m") for case in cases] if name == "one_step_error_m" else []
        case "twins" | "seeds" if name == "one_step_error_m":
            return []
    return [axis.of(case) for case in cases]

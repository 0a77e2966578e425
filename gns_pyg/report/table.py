"""The few lines that a run ends with: what the network does, beside what costs nothing and beside DEM."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gns_pyg.evaluation.ensemble import Ensemble
from gns_pyg.evaluation.errors import nanmean

MISSING = "-"
TWIN = "test/rollout_error_final_twin_m"
OBSERVED = [  # what, key, factor, unit
    ("overlap, 99.9th percentile", "test/overlap_ratio_999", 100.0, " %"),
    ("coordination number", "test/coordination_number", 1.0, ""),
    ("mean speed", "test/mean_speed_m_s", 1.0, " m/s"),
    ("granular temperature", "test/granular_temperature_m2_s2", 1e4, " cm\N{SUPERSCRIPT TWO}/s\N{SUPERSCRIPT TWO}"),
    ("discharge rate", "test/discharge_rate_kg_s", 1.0, " kg/s"),
    ("emptying time", "test/emptying_time_s", 1.0, " s"),
    ("mixing index, last frame", "test/mixing_index_final", 1.0, ""),
]


def text_table(title: str, rows: Sequence[tuple[str, str, str]], places: Mapping[str, object]) -> str:
    """Rows as plain text.

    Args:
        title: first line, e.g. the scene and the number of test cases.
        rows: of `metric_rows` or `ensemble_rows`.
        places: what -> where: run folder, plots, bundle.
    """
    return "\n".join([title, _grid(rows), *(f"{what}: {where}" for what, where in places.items())])


def metric_rows(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """The metrics of `evaluate_cases` in human units, as rows of (what, network, beside); the first is the heading."""

    def millimetres(key: str) -> str:
        return _number(metrics.get(key), 1e3, " mm")

    def percent(key: str) -> str:
        return _number(metrics.get(key), 100.0, " %")

    def degrees(key: str) -> str:
        return _number(metrics.get(key), 1.0, "\N{DEGREE SIGN}")

    def with_error(key: str, error: str) -> str:
        value = metrics.get(error)
        return degrees(key) + (f" \N{PLUS-MINUS SIGN} {value:.1f}\N{DEGREE SIGN}" if _known(value) else "")

    trivial = millimetres("test/one_step_error_trivial_m")
    trivial_name = metrics.get("test/one_step_error_trivial_name") or ""
    rows = [
        ("", "network", "beside"),
        (
            "one-step error, whole run",
            millimetres("test/one_step_error_m"),
            f"{trivial} {trivial_name} (best trivial predictor)",
        ),
        ("one-step error, at the start", millimetres("test/one_step_error_at_start_m"), ""),
        (
            "roll-out error, last frame",
            millimetres("test/rollout_error_final_m"),
            f"{millimetres('test/rollout_error_final_frozen_m')} frozen"
            + (f", {millimetres(TWIN)} DEM twins" if TWIN in metrics else ""),
        ),
        *(
            [
                (
                    "predictability horizon",
                    _number(metrics.get("test/horizon_s"), 1.0, " s"),
                    f"{_number(metrics.get('test/horizon_twin_s'), 1.0, ' s')} DEM twins",
                )
            ]
            if TWIN in metrics
            else []
        ),
        (
            "centre of mass error, largest",
            millimetres("test/center_of_mass_error_max_m"),
            f"{millimetres('test/center_of_mass_error_climatology_max_m')} mean of training cases, "
            f"{millimetres('test/center_of_mass_error_frozen_max_m')} frozen",
        ),
    ]
    if "test/angle_of_repose_deg" in metrics:
        rows += [
            (
                "angle of repose",
                with_error("test/angle_of_repose_deg", "test/angle_of_repose_standard_error_deg"),
                with_error("test/angle_of_repose_dem_deg", "test/angle_of_repose_dem_standard_error_deg") + " DEM",
            ),
            (
                "angle of repose error, per case",
                degrees("test/angle_of_repose_error_deg"),
                f"{degrees('test/angle_of_repose_error_climatology_deg')} mean of training cases",
            ),
        ]
    if "test/outflow_final" in metrics:
        rows += [
            ("grains that have left", percent("test/outflow_final"), f"{percent('test/outflow_dem_final')} DEM"),
            (
                "outflow error, largest",
                percent("test/outflow_error_max"),
                f"{percent('test/outflow_error_climatology_max')} mean of training cases",
            ),
        ]
    own, yade = (metrics.get(f"speed/{name}seconds_per_simulated_second") for name in ("", "yade_"))
    factor = ""
    if own is not None and yade is not None and own > 0:
        factor = (
            f", network {yade / own:.3g} times as fast" if own < yade else f", network slower, {own / yade:.3g} times"
        )
    n_threads = metrics.get("speed/threads")
    threads = f" (on {n_threads} thread{'' if n_threads == 1 else 's'})" if n_threads else ""
    cores, yade_dt = (
        _count(metrics.get("speed/yade_cores")),
        _number(metrics.get("speed/yade_dt_s"), 1e6, " \N{MICRO SIGN}s"),
    )
    rows += [
        (
            "overlap, of a diameter",
            percent("test/mean_overlap_ratio"),
            f"{percent('test/mean_overlap_ratio_dem')} DEM",
        ),
        *(
            (what, _number(metrics.get(key), factor, unit), f"{_number(metrics.get(f'{key}_dem'), factor, unit)} DEM")
            for what, key, factor, unit in OBSERVED
            if key in metrics
        ),
        ("escaped grains, all cases", _count(metrics.get("test/escaped_grains")), ""),
        (
            "time per simulated second",
            _number(own, 1.0, " s"),
            f"{_number(yade, 1.0, ' s')} Yade (dt {yade_dt}, {cores} core{'' if cores == '1' else 's'})"
            f"{factor}{threads}",
        ),
    ]
    return rows


def ensemble_rows(ensemble: Ensemble) -> list[tuple[str, str, str]]:
    """Every observable, mean over the roll-out: of the members, their spread, of DEM, and the CRPS; the first row is
    the heading."""
    rows = [("mean over the roll-out", f"{len(ensemble.error_m)} roll-outs", "beside")]
    scores = ensemble.crps()
    for name, members in ensemble.members.items():
        spread = nanmean(members.std(axis=0, ddof=1))
        own, dem = nanmean(members), nanmean(ensemble.dem[name])
        beside = f"{_number(dem, 1.0, '')} DEM; CRPS {_number(scores[name], 1.0, '')}"
        rows.append((name, f"{_number(own, 1.0, '')} \N{PLUS-MINUS SIGN} {_number(spread, 1.0, '')}", beside))
    rows.append(("escaped grains, most of any member", _count(ensemble.escaped), ""))
    return rows


def _grid(rows: Sequence[tuple[str, str, str]]) -> str:
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]}".rstrip() for row in rows]
    rule = "\N{BOX DRAWINGS LIGHT HORIZONTAL}" * max(len(line) for line in lines)
    return "\n".join([rule, lines[0], rule, *lines[1:], rule])


def _known(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _count(value: Any) -> str:
    return str(value) if _known(value) else MISSING


def _number(value: Any, factor: float, unit: str) -> str:
    """Three significant digits, never an exponent where digits will do."""
    if not _known(value):
        return MISSING
    scaled = factor * value
    if scaled and not 1e-4 <= abs(scaled) < 1e6:
        return f"{scaled:.2e}{unit}"
    decimals = 2 if scaled == 0 else max(0, 2 - int(f"{abs(scaled):e}".split("e")[1]))
    return f"{scaled:.{decimals}f}{unit}"

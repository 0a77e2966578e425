"""docs/results.md from docs/results.json: every figure beside what it is to be held against, and whether it holds."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scipy.stats import t

SCORES = {  # goals of the one-step error, m
    "hopper": 3.0e-4,
    "drum": 4.0e-4,
    "inclined_drum": 4.0e-4,
    "hopper_full": 3.0e-4,
    "drum_full": 4.0e-4,
}
Z_95 = 1.96
CAPTIONS = {
    "one_step_error": "one-step error along the run",
    "rollout_error": "position error of the roll-out, beside DEM twins",
    "center_of_mass": "height of the centre of mass",
    "angle_of_repose": "angle of repose",
    "mean_speed": "mean speed",
    "granular_temperature": "granular temperature",
    "overlap": "overlap",
    "snapshots": "DEM and network from the same start",
    "ensemble": "ensemble: mean and spread beside DEM",
}
HEAD = """# Results

Written by `gns_pyg.results` from [results.json](results.json): the bundles that ship with the project, on Yade cases
that they have not seen. First the reduced scenes (220 to 300 grains; `make results`, on the embedded cases), then the
paper's at full size (`hopper_full`, `drum_full`; on cases made by the commands in [full_size.md](full_size.md)). How
these bundles came about is in [experiments.md](experiments.md), [answers.md](answers.md) and
[full_size.md](full_size.md). Means over unseen cases, ± the standard deviation over them; roll-outs from 0.1 s to the
end, read every 10 ms. The last column says whether the goal that we set ourselves holds, on this scene and these
cases. Twins are two DEM runs that start a micrometre apart: where they differ by more than a goal allows, DEM itself
does not meet it. Times are of that run, whatever else the machine did, Yade's too (alone, it takes half as long on
the full-size hopper, less than the network: [full_size.md](full_size.md)); [performance.md](performance.md) measures
speed with care.
"""


def results_page(found: Mapping[str, Any]) -> str:
    """The page, Markdown.

    Args:
        found: scene name -> what `gns_pyg.results.results` found, as plain JSON values.
    """
    return "\n".join([HEAD, *(_scene(name, values) for name, values in found.items())])


def _scene(name: str, values: Mapping[str, Any]) -> str:
    m, spread, scatter = values["metrics"], values["spread"], values["seed_scatter"]
    own, yade = m["speed/seconds_per_simulated_second"], m["speed/yade_seconds_per_simulated_second"]
    lines = [
        f"## {name} (`bundle={values['bundle']}`)\n",
        f"Trained on {values['trained_on']} cases; {len(values['cases'])} unseen. {own:.2g} s per simulated second on "
        f"one thread of an {m['speed/device']}; Yade {yade:.2g} s at a step of {1e6 * m['speed/yade_dt_s']:.0f} µs on "
        f"one core: the network takes {own / yade:.2g} times Yade's time.\n",
        "| | network | beside | goal | holds |",
        "|---|---|---|---|---|",
        *_rows(values["bundle"], m, spread, scatter, values["cases"]),
    ]
    ensemble = values["ensemble"]
    lines += [
        f"\n{ensemble['members']} roll-outs a micrometre apart, first unseen case; CRPS (mean over frames): "
        + ", ".join(f"{key} {score:.3g}" for key, score in ensemble["crps"].items())
        + f". Escaped grains, most of any member: {ensemble['escaped_grains']}."
    ]
    cases = values["long"]["cases"]
    lines += [
        "\nLong runs, beside DEM runs as long, read every 50 ms:\n",
        "| duration, s | angle of repose, steady part, degrees | DEM | mean speed in the last half, m/s | DEM "
        "| grains lost |",
        "|---|---|---|---|---|---|",
        *(
            f"| {case['duration_s']:g} | {_angle(case, '')} | {_angle(case, '_dem')} "
            f"| {_text(case['late_mean_speed_m_s'], 1.0)} | {_text(case['late_mean_speed_dem_m_s'], 1.0)} "
            f"| {case['escaped_grains']} |"
            for case in cases
        ),
        *_equivalence(cases),
    ]
    if values["held_out"]:
        lines += [
            "\nConditions it was never trained on, two cases each, beside the training cases' mean (climatology).\n",
            "| condition | one step, mm (trivial) | centre of mass, mm (climatology) | angle error, degrees "
            "(climatology) | mean speed, m/s (DEM) | escaped | better than climatology in both |",
            "|---|---|---|---|---|---|---|",
            *(_condition(condition, metrics) for condition, metrics in values["held_out"].items()),
        ]
    lines += ["", *(f"![{text}](figures/results_{values['bundle']}_{key}.png)" for key, text in CAPTIONS.items()), ""]
    return "\n".join(lines)


def _rows(
    bundle: str,
    m: Mapping[str, Any],
    spread: Mapping[str, Any],
    scatter: Mapping[str, Any],
    cases: Sequence[Mapping[str, Any]],
) -> list[str]:
    """Rows of what can be said of the scene."""

    def value(key: str, factor: float, unit: str) -> str:
        return f"{_text(m[key], factor)} ± {_text(spread.get(key), factor, 2)} {unit}"

    def row(what: str, own: str, beside: str, goal: str, holds: bool) -> str:
        return f"| {what} | {own} | {beside} | {goal} | {'yes' if holds else '**no**'} |"

    def against_dem(what: str, key: str, factor: float, unit: str, goal: str, holds: Callable[[float], bool]) -> str:
        ratio = m[key] / m[f"{key}_dem"]
        return row(
            what, value(key, factor, unit), f"DEM {_text(m[f'{key}_dem'], factor)}: {ratio:.2f}", goal, holds(ratio)
        )

    step, trivial = m["test/one_step_error_m"], m["test/one_step_error_trivial_m"]
    most, center = SCORES[bundle], m["test/center_of_mass_error_max_m"]
    climatology = m["test/center_of_mass_error_climatology_max_m"]
    twins = m.get("test/center_of_mass_error_twin_max_m")
    rows = [
        row(
            "one-step error (10 ms)",
            value("test/one_step_error_m", 1e3, "mm"),
            f"best trivial {_text(trivial, 1e3)} mm: {step / trivial:.2f}",
            f"at most 0.45 of it and {1e3 * most:g} mm",
            step <= min(most, 0.45 * trivial),
        ),
        row(
            "centre of mass, largest error",
            value("test/center_of_mass_error_max_m", 1e3, "mm"),
            f"climatology {_text(climatology, 1e3)} mm"
            + ("" if twins is None else f", twins {_text(twins, 1e3)} mm: {center / twins:.2f} of theirs"),
            "at most 4 mm and 0.7 of climatology's",
            center <= min(4e-3, 0.7 * climatology),
        ),
    ]
    if "test/rollout_error_over_twin" in m:
        ratio, reach = m["test/rollout_error_over_twin"], m["test/horizon_s"] / m["test/horizon_twin_s"]
        rows += [
            row(
                "roll-out error, last frame",
                value("test/rollout_error_final_m", 1e3, "mm"),
                f"twins {_text(m['test/rollout_error_final_twin_m'], 1e3)} mm; over twins' from 1 s on: {ratio:.2f}",
                "0.85 to 1.15 of the twins'",
                0.85 <= ratio <= 1.15,
            ),
            row(
                "predictability horizon",
                value("test/horizon_s", 1.0, "s"),
                f"twins {_text(m['test/horizon_twin_s'], 1.0)} s: {reach:.2f}",
                "at least 0.6 of the twins'",
                reach >= 0.6,
            ),
        ]
    if "test/angle_of_repose_deg" in m:
        apart = m.get("test/angle_of_repose_error_twin_deg")
        angle, dem = "test/angle_of_repose_deg", "test/angle_of_repose_dem_deg"
        in_time = math.hypot(
            m["test/angle_of_repose_standard_error_deg"], m["test/angle_of_repose_dem_standard_error_deg"]
        )
        off, error, over = _off([(case[angle], case[dem]) for case in cases]) or (
            m[angle] - m[dem],
            Z_95 * in_time,
            "95 % in time: too few cases",
        )
        rows.append(
            row(
                "angle of repose",
                value("test/angle_of_repose_deg", 1.0, "degrees"),
                f"DEM {_text(m['test/angle_of_repose_dem_deg'], 1.0)}, scatter of seeds "
                f"{_text(scatter['angle_of_repose_deg'], 1.0)}"
                + ("" if apart is None else f", twins {_text(apart, 1.0)} apart")
                + f": {off:+.1f} ± {error:.1f} off ({over})",
                "within 1 degree at 95 %",
                abs(off) + error <= 1.0,
            )
        )
    rows += [
        against_dem("mean speed", "test/mean_speed_m_s", 1.0, "m/s", "within 5 %", lambda r: abs(r - 1) <= 0.05),
        against_dem(
            "granular temperature",
            "test/granular_temperature_m2_s2",
            1e4,
            "cm²/s²",
            "within 15 %",
            lambda r: abs(r - 1) <= 0.15,
        ),
        against_dem("mean overlap", "test/mean_overlap_ratio", 100.0, "%", "at most 2 times", lambda r: r <= 2),
        against_dem(
            "overlap, 99.9th percentile", "test/overlap_ratio_999", 100.0, "%", "at most 1.5 times", lambda r: r <= 1.5
        ),
        row("grains lost", str(m["test/escaped_grains"]), "", "0", m["test/escaped_grains"] == 0),
    ]
    return rows


def _angle(case: Mapping[str, Any], of: str) -> str:
    error = case[f"angle_of_repose{of}_standard_error_deg"]
    return f"{_text(case[f'angle_of_repose{of}_deg'], 1.0)} ± {_text(error, 1.0, 2)}"


def _equivalence(cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Whether the angles of long runs are those of DEM within 1 degree; nothing for less than three cases."""
    if (found := _off([(c["angle_of_repose_deg"], c["angle_of_repose_dem_deg"]) for c in cases])) is None:
        return []
    mean, within, over = found
    holds = abs(mean) + within <= 1.0
    return [
        f"\nAngle of repose in long runs: {mean:+.2f} ± {within:.2f} degrees off ({over}); within 1 "
        f"degree: {'yes' if holds else '**no**'}."
    ]


def _off(angles: Sequence[tuple[float | None, float]]) -> tuple[float, float, str] | None:
    """By how much the angles of cases are off, how far that mean is known (half of its 95 % confidence interval,
    Student's t over the cases), and over how many; nothing for less than three."""
    off = [own - dem for own, dem in angles if own is not None]
    if len(off) < 3:
        return None
    error = statistics.stdev(off) / math.sqrt(len(off)) * float(t.ppf(0.975, len(off) - 1))
    return statistics.mean(off), error, f"95 %, {len(off)} cases"


def _condition(condition: str, m: Mapping[str, Any]) -> str:
    center, expected = m["test/center_of_mass_error_max_m"], m["test/center_of_mass_error_climatology_max_m"]
    angle, expected_angle = m["test/angle_of_repose_error_deg"], m["test/angle_of_repose_error_climatology_deg"]
    better = center < expected and angle < expected_angle
    return (
        f"| {condition} | {_text(m['test/one_step_error_m'], 1e3)} ({_text(m['test/one_step_error_trivial_m'], 1e3)}) "
        f"| {_text(center, 1e3)} ({_text(expected, 1e3)}) | {_text(angle, 1.0)} ({_text(expected_angle, 1.0)}) "
        f"| {_text(m['test/mean_speed_m_s'], 1.0)} ({_text(m['test/mean_speed_m_s_dem'], 1.0)}) "
        f"| {m['test/escaped_grains']} | {'yes' if better else '**no**'} |"
    )


def _text(value: Any, factor: float, digits: int = 3) -> str:
    """So many significant digits, never an exponent; "-" where there is no figure."""
    if value is None:
        return "-"
    scaled = factor * value
    decimals = 4 if abs(scaled) < 1e-4 else max(0, digits - 1 - math.floor(math.log10(abs(scaled))))
    return f"{scaled:.{decimals}f}"

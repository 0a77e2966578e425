"""The table as a Markdown page, every row of every scene; written by stage=table, never by hand."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gns_pyg.tradeoff.axes import AXES
from gns_pyg.tradeoff.front import Row, best_network, equivalent_yade, error, runnable, seconds

HEAD = """# Trade-off: every row

Written by `python tradeoff.py experiment=... stage=table out=docs` from [tradeoff.json](tradeoff.json);
[tradeoff.md](tradeoff.md) says what it means. Means over the unseen cases, the range over them in brackets. Seconds are
processor seconds per simulated second on one thread, medians. **F**: on the front of time, centre of mass and angle of
repose. **=**: all observables within what DEM seeds differ by (the largest difference between two of them).
"""


def page(tables: Mapping[str, Sequence[Row]]) -> str:
    """The page.

    Args:
        tables: experiment -> rows.
    """
    return "\n".join([HEAD, *(_scene(name, rows) for name, rows in tables.items())])


def _scene(name: str, rows: Sequence[Row]) -> str:
    timed = sorted(runnable(rows), key=seconds)
    rest = [row for row in rows if row not in timed]
    lines = [f"## {name}\n", *_about(rows), ""]
    heading = ["", "row", "s per simulated s", "MiB", *(axis.title for axis in AXES.values()), "pays after roll-outs"]
    lines += [f"| {' | '.join(heading)} |", "|---" * len(heading) + "|"]
    lines += [f"| {' | '.join(_cells(row))} |" for row in [*timed, *(row for row in rest if row["error"] is None)]]
    failed = [row for row in rest if row["error"] is not None]
    lines += ["", *(f"- {row['name']}: failed. {' '.join(row['error'].split())}" for row in failed), ""]
    return "\n".join(lines)


def _about(rows: Sequence[Row]) -> list[str]:
    networks = [row for row in rows if row["kind"] == "trained"]
    yade = equivalent_yade(rows)
    processors = {row["time"]["processor"] for row in rows if row.get("time")}
    said = "none: every step measured leaves the scatter, or none was measured"
    budget_s = networks[0]["budget_cpu_s"] if networks else 0
    return [
        f"{len(networks)} trained points, about {budget_s:g} s of processor time each, "
        f"on one thread of {' or '.join(sorted(processors)) or 'a machine that was not asked (no times)'}.",
        f"Yade's largest step that shows the same: {said if yade is None else yade['name']}.",
        f"Fastest network whose centre of mass and angle of repose are within what seeds differ by: {_headline(rows)}.",
    ]


def _headline(rows: Sequence[Row]) -> str:
    best = best_network(rows)
    if best is None:
        return "none"
    steps = [row for row in runnable(rows) if row["kind"] == "yade"]
    paper = min(steps, key=lambda row: row["dt_s"], default=None)
    beside = [row for row in (equivalent_yade(rows), paper) if row is not None]
    factors = [f"{seconds(row) / seconds(best):.3g} times as fast as {row['name']}" for row in beside]
    pays = best.get("break_even_rollouts")
    known = {None: "what its training cost is not known", "never": "so it never pays"}
    return ", ".join([best["name"], *factors, known.get(pays, f"it pays after {pays} roll-outs")])


def _cells(row: Row) -> list[str]:
    marks = ("F" if row["front"] else "") + ("=" if row["within_scatter"] else "")
    time = row.get("time") or {}
    per_s = f"{seconds(row):.3g}" if math.isfinite(seconds(row)) else ""
    memory = f"{time['peak_memory_mib']:.0f}" if time.get("peak_memory_mib") else ""
    pays = row.get("break_even_rollouts")
    figures = [_figure(row, axis) for axis in AXES]
    return [marks, row["name"], per_s, memory, *figures, "" if pays is None else str(pays)]


def _figure(row: Row, axis: str) -> str:
    if not math.isfinite(error(row, axis)):
        return ""
    values: Mapping[str, Any] = row["axes"][axis]
    mean, least, most = (AXES[axis].factor * values[key] for key in ("mean", "least", "most"))
    return f"{mean:.3g} ({least:.3g} to {most:.3g})"

"""The stability verdict as a table and a picture."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gns_pyg.evaluation.stress import Line

MARKS = {True: "holds", False: "FAILS", None: "-"}


@dataclass(frozen=True)
class Verdict:
    """What stress.py found of a bundle.

    Attributes:
        form: full or short.
        lines: hard ones first.
    """

    form: str
    lines: Sequence[Line]


def mark(line: Line) -> str:
    """holds, FAILS, a figure without a mark (`-`), or `no mark` (found says why)."""
    return "no mark" if line.hard and line.holds is None else MARKS[line.holds]


def verdict_table(lines: Sequence[Line], title: str, places: Mapping[str, object]) -> str:
    """Plain text, a block a line of the verdict; hard lines first."""
    width = max(len(line.line) for line in lines)
    rows = [title, ""]
    for heading, hard in (("must hold", True), ("measured", False)):
        chosen = [line for line in lines if line.hard == hard]
        rows += [heading] if chosen else []
        for line in chosen:
            first, *more = textwrap.wrap(line.found, 150, break_long_words=False) or [""]
            rows.append(f"  {mark(line):<8}{line.line:<{width}}  {first}")
            rows += [" " * (width + 12) + text for text in more]
    return "\n".join([*rows, "", *(f"{what}: {where}" for what, where in places.items())])


def verdict_markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """The plain form of the lines as a Markdown table."""
    rows = ["| line | verdict | found |", "|---|---|---|"]
    for entry in lines:
        line = Line(**entry)
        shown = f"**{mark(line)}**" if line.holds is False else mark(line)
        rows.append(f"| {line.line} | {shown} | {line.found.replace('|', '/')} |")
    return "\n".join(rows)


def draw_verdict(curves: Mapping[str, Any], title: str) -> Figure:
    """Kinetic energy of the long roll-out beside DEM's, and how far the settled pile has moved."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    energy, pile = figure.subplots(1, 2)
    if found := curves.get("long"):
        if "dem_times_s" in found:
            energy.plot(found["dem_times_s"], found["dem_energy_j"], color="0.55", label="DEM", linewidth=1.5)
        energy.plot(
            found["times_s"], found["energy_j"], color="#0072B2", label="network", linewidth=1.0, linestyle="--"
        )
        energy.set_yscale("symlog", linthresh=1e-6)
        energy.legend(frameon=False)
    energy.set(xlabel="time, s", ylabel="kinetic energy, J", title="ten times the trained length")
    if found := curves.get("settled"):
        steps = np.linspace(0, found["steps"], len(found["moved_m"]))
        pile.plot(steps, 1e3 * np.array(found["moved_m"]), color="#D55E00")
    pile.set(xlabel="step", ylabel="centre of mass moved, mm", title="settled pile")
    figure.suptitle(title)
    return figure

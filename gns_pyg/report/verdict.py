"""The stability verdict as a table and a picture."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gns_pyg.evaluation.stress import Line

LEAST_J = 1e-6  # a picture of energies is linear below
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


def draw_verdict(curves: Mapping[str, Any], title: str) -> Figure | None:
    """Kinetic energy of the long roll-out beside DEM's, and how far the settled pile has moved: of what was run; None
    where neither was."""
    drawn = [(draw, curves[name]) for name, draw in (("long", _energy), ("settled", _pile)) if name in curves]
    if not drawn:
        return None
    figure = Figure(figsize=(4.5 * len(drawn), 3.6), layout="constrained")
    for axes, (draw, found) in zip(figure.subplots(1, len(drawn), squeeze=False)[0], drawn, strict=True):
        draw(axes, found)
    figure.suptitle(title)
    return figure


def _energy(axes: Axes, found: Mapping[str, Any]) -> None:
    if "dem_times_s" in found:
        axes.plot(found["dem_times_s"], found["dem_energy_j"], color="0.55", label="DEM", linewidth=1.5)
    axes.plot(found["times_s"], found["energy_j"], color="#0072B2", label="network", linewidth=1.0, linestyle="--")
    axes.set_yscale("symlog", linthresh=LEAST_J)
    energies = np.concatenate([line.get_ydata() for line in axes.lines])
    if energies.min() > LEAST_J:  # whole decades: within one, a logarithmic axis has no two numbers to read it by
        axes.set_ylim(10 ** np.floor(np.log10(energies.min())), 10 ** np.ceil(np.log10(energies.max())))
    axes.legend(frameon=False)
    axes.set(xlabel="time, s", ylabel="kinetic energy, J", title="ten times the trained length")


def _pile(axes: Axes, found: Mapping[str, Any]) -> None:
    steps = np.linspace(0, found["steps"], len(found["moved_m"]))
    axes.plot(steps, 1e3 * np.array(found["moved_m"]), color="#D55E00")
    axes.set(xlabel="step", ylabel="centre of mass moved, mm", title="settled pile")

"""The trade-off drawn: a figure for print, and one page to point at, each from the table alone."""

import html
import json
import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gns_pyg.files import whole
from gns_pyg.report.plots import BLUE, GREEN, ORANGE, PURPLE, VERMILION
from gns_pyg.tradeoff.axes import AXES
from gns_pyg.tradeoff.front import RUNS, Row, equivalent_yade, error, front, runnable, seconds

GREY = "#4d4d4d"
PAGE = Path(__file__).with_name("page.html")
STYLES = {  # kind -> marker, colour, in words
    "trained": ("o", BLUE, "networks, equal budget"),
    "without_training": ("s", PURPLE, "the same, run otherwise"),
    "shipped": ("D", ORANGE, "shipped bundle, trained far longer"),
    "yade": ("^", VERMILION, "Yade, by time step"),
}
YARDSTICKS = {  # kind -> line style, colour, in words
    "twins": ("--", GREEN, "DEM twins"),
    "seeds": ("-", GREEN, "another DEM seed"),
    "climatology": (":", GREY, "climatology"),
    "trivial": ("-.", GREY, "best trivial step"),
}


def draw(rows: Sequence[Row], scene: str) -> Figure:
    """Every axis of accuracy against processor seconds per simulated second, both logarithmic; bars from the least to
    the most accurate case, the front of time and that axis joined, yardsticks across, what seeds differ by shaded."""
    shown = [axis for axis in AXES if any(math.isfinite(error(row, axis)) for row in runnable(rows))]
    columns = 2
    figure = Figure(figsize=(11, 3.6 * math.ceil(len(shown) / columns) + 0.8), layout="constrained")
    figure.suptitle(f"{scene}: accuracy against processor time, one thread")
    grid = figure.subplots(math.ceil(len(shown) / columns), columns, squeeze=False)
    for spare in grid.flat[len(shown) :]:
        spare.remove()
    for axes, axis in zip(grid.flat, shown, strict=False):
        _panel(axes, rows, axis)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    for axes in grid.flat[1 : len(shown)]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def _panel(axes: Axes, rows: Sequence[Row], axis: str) -> None:
    factor = AXES[axis].factor
    told = [row for row in runnable(rows) if math.isfinite(error(row, axis))]
    for kind, (marker, color, label) in STYLES.items():
        mine = [row for row in told if row["kind"] == kind]
        if mine:
            mean = [factor * error(row, axis) for row in mine]
            spans = [
                [abs(factor * row["axes"][axis][end] - at) for row, at in zip(mine, mean, strict=True)]
                for end in ("least", "most")
            ]
            x = [seconds(row) for row in mine]
            axes.errorbar(x, mean, spans, fmt=marker, markersize=5, elinewidth=0.7, color=color, label=label)
    best = front(rows, (axis,))
    best = [row for row in best if math.isfinite(error(row, axis))]
    x, y = [seconds(row) for row in best], [factor * error(row, axis) for row in best]
    axes.step(x, y, where="post", color="0.6", linewidth=1, zorder=0)
    for kind, (style, color, label) in YARDSTICKS.items():
        row = next((row for row in rows if row["kind"] == kind and axis in row["axes"]), None)
        if row is not None and error(row, axis) > 0:
            axes.axhline(factor * error(row, axis), linestyle=style, color=color, linewidth=1, label=label)
            if kind == "seeds":
                ends = (factor * row["axes"][axis][end] for end in ("least", "most"))
                axes.axhspan(*ends, color=color, alpha=0.12, linewidth=0, label="what seeds differ by")
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=1) if axis == "escaped_grains" else axes.set_yscale("log")
    axes.set_xlabel("processor seconds per simulated second", fontsize=8)
    axes.set_title(AXES[axis].title, fontsize=9, loc="left")
    axes.tick_params(labelsize=7)
    axes.grid(visible=True, which="major", color="0.9")


def write_page(path: Path, rows: Sequence[Row], scene: str) -> None:
    """Writes the interactive figure: one HTML file without anything from elsewhere."""
    yade = equivalent_yade(rows)
    data = {
        "axes": {name: [axis.title, axis.factor] for name, axis in AXES.items()},
        "styles": {kind: [color, label] for kind, (_, color, label) in STYLES.items()},
        "yardsticks": {kind: [color, label] for kind, (_, color, label) in YARDSTICKS.items()},
        "rows": [
            {"name": row["name"], "kind": row["kind"], "axes": row["axes"]}
            | {"s": seconds(row) if row["kind"] in RUNS else None, "pays": row.get("break_even_rollouts")}
            for row in rows
            if row["error"] is None and (row["kind"] not in RUNS or math.isfinite(seconds(row)))
        ],
        "equivalent": None if yade is None else yade["name"],
    }
    title = html.escape(f"{scene}: speed against accuracy")
    text = (
        PAGE.read_text(encoding="utf-8").replace("TITLE", title).replace("DATA", json.dumps(data).replace("</", "<\\/"))
    )
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")

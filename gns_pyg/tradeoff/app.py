"""What `tradeoff.py` does, stage by stage."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gns_pyg.config import require
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.files import whole
from gns_pyg.report.plots import write_figure
from gns_pyg.tradeoff.front import front, runnable, seconds
from gns_pyg.tradeoff.job import do
from gns_pyg.tradeoff.pictures import draw, write_page
from gns_pyg.tradeoff.points import points
from gns_pyg.tradeoff.recommend import told
from gns_pyg.tradeoff.rows import table
from gns_pyg.tradeoff.search import search
from gns_pyg.tradeoff.tables import page
from gns_pyg.tradeoff.timing import times

log = logging.getLogger(__name__)


def tradeoff(cfg: DictConfig) -> Any:
    """Runs the stage that `cfg` names."""
    stages: dict[str, Callable[[DictConfig], Any]] = {
        "run": work,
        "list": names,
        "time": times,
        "table": collect,
        "search": search,
    }
    require(cfg.stage in stages, "stage", cfg.stage, ", ".join(stages), "pick one of them")
    return stages[cfg.stage](cfg)


def names(cfg: DictConfig) -> list[str]:
    """Prints and returns the points' names, in order."""
    found = [f"{point.kind}: {point.name}" for point in points(cfg)]
    log.info("%s", "\n".join(f"{number:3} {name}" for number, name in enumerate(found)))
    return found


def work(cfg: DictConfig) -> list[dict[str, Any]]:
    """Does the point of `cfg`, or every one that no other process works on; returns the rows."""
    todo = points(cfg)
    if cfg.point is not None:
        known = isinstance(cfg.point, int) and 0 <= cfg.point < len(todo)
        require(known, "point", cfg.point, f"0 to {len(todo) - 1}", "stage=list names them")
        todo = [todo[cfg.point]]
    rows = []
    for point in todo:
        row = do(cfg, point)
        log.info("%s: %s", point.name, "in work elsewhere" if row is None else row["error"] or "done")
        rows += [] if row is None else [row]
    return rows


def collect(cfg: DictConfig) -> list[dict[str, Any]]:
    """Writes the table of all finished points beside those of other scenes in `cfg.out`, tradeoff.json and
    tradeoff_table.md, its figure and the page to point at; prints the front."""
    rows, out = table(cfg), Path(cfg.out)
    path = out / "tradeoff.json"
    others = json.loads(path.read_text()) if path.is_file() else {}
    write_json(path, tables := others | {cfg.experiment: rows})
    with whole(out / "tradeoff_table.md") as temporary:
        temporary.write_text(page(tables), encoding="utf-8")
    if runnable(rows):
        write_figure(draw(rows, cfg.experiment), out / "figures" / f"tradeoff_{cfg.experiment}")
        write_page(out / "figures" / f"tradeoff_{cfg.experiment}.html", rows, cfg.experiment)
    else:
        log.info("nothing is timed yet, so there is nothing to draw: stage=time")
    for row in front(rows):
        log.info("%.3g s per simulated second: %s; %s", seconds(row), row["name"], "; ".join(told(row)))
    log.info("%d rows -> %s", len(rows), path)
    return rows

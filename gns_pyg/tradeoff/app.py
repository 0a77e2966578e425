"""What `tradeoff.py` does, stage by stage."""

import logging
from typing import Any

from omegaconf import DictConfig

from gns_pyg.config import require
from gns_pyg.tradeoff.job import do
from gns_pyg.tradeoff.points import points

log = logging.getLogger(__name__)


def tradeoff(cfg: DictConfig) -> Any:
    """Runs the stage that `cfg` names."""
    stages = {"run": work, "list": names}
    require(cfg.stage in stages, "stage", cfg.stage, " or ".join(stages), "pick one of them")
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

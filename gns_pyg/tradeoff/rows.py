"""The table: the rows that are there, each with its axes, its time and its break-even."""

import json
import math
from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig

from gns_pyg.tradeoff import front
from gns_pyg.tradeoff.axes import axes_of
from gns_pyg.tradeoff.job import folder_of
from gns_pyg.tradeoff.points import NETWORKS, Point, cases_of, points

LEFT_OUT = ("cases", "metrics")  # in the run's own row.json
SHOWN = ("test/rollout_error_final_m", "test/mean_overlap_ratio", "test/granular_temperature_m2_s2")


def row_of(cfg: DictConfig, point: Point) -> dict[str, Any] | None:
    """A point's row with its time, or None if it is not there yet."""
    folder = folder_of(cfg, point)
    if not (folder / "row.json").is_file():
        return None
    time = folder / "time.json"
    return json.loads((folder / "row.json").read_text()) | {
        "time": json.loads(time.read_text()) if time.is_file() else None
    }


def table(cfg: DictConfig) -> list[dict[str, Any]]:
    """The rows that are there, in the order of the points."""
    found = [row for point in points(cfg) if (row := row_of(cfg, point)) is not None]
    rows: list[dict[str, Any]] = []
    for row in found:
        kept = {key: value for key, value in row.items() if key not in LEFT_OUT}
        metrics = row.get("metrics") or {}
        rows.append(kept | {key.removeprefix("test/"): metrics.get(key) for key in SHOWN} | {"axes": axes_of(row)})
    cost = costs(cfg, rows)
    on_front = [row["name"] for row in front.front(rows)]
    for row in rows:
        row["front"] = row["name"] in on_front
        row["within_scatter"] = front.within_scatter(row, rows) if row["error"] is None else False
        if row["kind"] in NETWORKS and row["error"] is None:
            after = front.break_even(row, rows, cost)
            row["break_even_rollouts"] = "never" if after == math.inf else after and int(after)
    return rows


def costs(cfg: DictConfig, rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """What `front.break_even` needs: Yade's seconds for the training cases at its equivalent step, as timed here (as
    stored with them where it is not), and the length of a roll-out."""
    cases = cases_of(cfg)
    yade = front.equivalent_yade(rows)
    rate = math.inf if yade is None else front.seconds(yade)
    stored = sum(float(case.run.get("cpu_time_s", case.run["wall_clock_s"])) for case in cases.train)
    simulated = [case.times_s[-1] - case.times_s[0] for case in cases.train]
    timed = rate * float(sum(simulated))
    return {"cases_s": timed if math.isfinite(timed) else stored, "simulated_s": float(simulated[0] - cfg.start_s)}

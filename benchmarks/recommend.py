"""Does `tradeoff.py recommend` keep its word? `python -m benchmarks.recommend [results folder of hopper]`.

For each budget the configuration that the committed table names is run again on the table's unseen cases, and timed
again: its time should be within 20 % of what the table says, its errors within the range that it gives. Writes
benchmarks/results/recommend.json. A trained point needs the folder that its sweep wrote (runs/tradeoff/...).
"""

import sys
from pathlib import Path
from statistics import median
from typing import Any

import torch
from hydra import compose, initialize_config_dir

from gns_pyg import machine
from gns_pyg.config import CONF
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.tradeoff.axes import axes_of
from gns_pyg.tradeoff.front import choose, seconds
from gns_pyg.tradeoff.job import beside, judged
from gns_pyg.tradeoff.points import NETWORKS, Point, cases_of
from gns_pyg.tradeoff.recommend import read_table
from gns_pyg.tradeoff.timing import apart, once

ROOT = Path(__file__).parents[1]
OUT = ROOT / "benchmarks" / "results" / "recommend.json"
BUDGETS: dict[str, tuple[float | None, dict[str, float]]] = {  # for 1 s of the hopper: processor seconds, errors
    "max_seconds=0.7": (0.7, {}),
    "max_seconds=5": (5.0, {}),
    "max_center_of_mass_error_m=0.01 max_angle_of_repose_error_deg=2": (
        None,
        {"center_of_mass_error_m": 0.01, "angle_of_repose_error_deg": 2.0},
    ),
}
ROUNDS = 5
SLACK = 1e-9  # of an error: the table's own rounding


def main(folder: str | None) -> None:
    torch.set_num_threads(1)
    with initialize_config_dir(f"{CONF}/tradeoff", version_base="1.3"):
        cfg = compose("tradeoff", [f"results={folder}"] if folder else [])
    rows = read_table(ROOT / "docs" / "tradeoff.json", "hopper")
    case = cases_of(cfg).test[0]
    found = {}
    for budget, (most_s, errors) in BUDGETS.items():
        row = choose(rows, 1.0, most_s, errors)
        if row is None:
            found[budget] = {"named": None}
            continue
        point = Point(row["kind"], tuple(row["training"]), tuple(row["running"]))
        again = (judged if point.kind in NETWORKS else beside)(cfg, point) | {"kind": point.kind}
        rounds = [apart(lambda point=point: once(cfg, point, case)) for _ in range(ROUNDS)]  # type: ignore[misc]
        now_s = median(each["cpu_s_per_simulated_s"] for each in rounds)
        found[budget] = compared(row, axes_of(again), now_s)
        print(budget, found[budget], sep="\n   ", flush=True)
    write_json(OUT, {"processor": machine.processor(), "rounds": ROUNDS, "budgets": found})


def compared(row: Any, again: dict[str, Any], now_s: float) -> dict[str, Any]:
    """What the table says of a row beside what was found again."""
    axes = {}
    for name, told in row["axes"].items():
        mean, least, most = again[name]["mean"], told["least"], told["most"]
        inside = least * (1 - SLACK) - SLACK <= mean <= most * (1 + SLACK) + SLACK
        axes[name] = {"told": [least, most], "again": mean, "inside": inside}
    return {
        "named": row["name"],
        "told_s": seconds(row),
        "again_s": now_s,
        "time_ratio": now_s / seconds(row),
        "errors_inside": all(axis["inside"] for axis in axes.values()),
        "errors": axes,
    }


if __name__ == "__main__":
    main(sys.argv[1] if sys.argv[1:] else None)

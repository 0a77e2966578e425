"""Measures the quick ratios again and compares them with the committed ones: `make bench`.

Ratios of figures taken side by side in one run carry over from machine to machine better than seconds; what needs Yade,
other programs or hours is left to its own benchmark. Nothing is written. A line says what cannot be measured here.
"""

import json
import os
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchmarks import neighbors, peers, phases, requirements, scaling
from gns_pyg.errors import GnsError

RESULTS = Path(__file__).parent / "results"
APART = 1.25  # a ratio that differs by more than this factor is pointed out


def main() -> None:
    torch.set_num_threads(1)
    print(f"{'ratio':<58} {'committed':>9} {'now':>9}")
    for measure in (of_peers, of_phases, of_scaling, of_neighbors, of_requirements):
        try:
            with redirect_stdout(StringIO()):  # they print their own tables
                ratios = measure()
            for name, committed, now in ratios:
                note = "" if 1 / APART < now / committed < APART else "  <- differs"
                print(f"{name:<58} {committed:>9.3f} {now:>9.3f}{note}", flush=True)
        except (GnsError, FileNotFoundError, SystemExit) as error:
            print(f"{measure.__name__[3:]}: not measured here\n{error}", flush=True)


def stored(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text())


def of_peers() -> list[tuple[str, float, float]]:
    folder = Path(os.environ.get("GNS_PEERS", "peers"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder} with other systems: see benchmarks/peers.py, set GNS_PEERS")
    with TemporaryDirectory() as temporary:
        out = Path(temporary) / "peers.json"
        peers.main(["--peers", str(folder), "--rounds", "5", "--out", str(out)])
        now = json.loads(out.read_text())
    keys = ("forward_ratio_to_best_peer", "training_ratio_to_best_peer")
    return [(f"peers: {key}", stored("peers")[key], now[key]) for key in keys]


def of_phases() -> list[tuple[str, float, float]]:
    now, then = phases.profile(1), stored("phases")["rows"][0]
    search = "neighbour search, ms"
    return [("phases: share of the neighbour search", then[search] / then["step_ms"], now[search] / now["step_ms"])]


def of_scaling() -> list[tuple[str, float, float]]:
    rows = {row["grains"]: row for row in stored("scaling")["rows"]}
    few, many = list(scaling.SIZES)[:2]
    now = scaling.measured(many)["seconds"] / scaling.measured(few)["seconds"]
    return [("scaling: 10 times the grains, times the time", rows[many]["seconds"] / rows[few]["seconds"], now)]


def of_neighbors() -> list[tuple[str, float, float]]:
    then = {(r["task"], r["backend"]): r["ms"] for r in stored("neighbors") if r["points"] == 25_000}
    grains = neighbors.packing(25_000, torch.device("cpu"))
    found = neighbors.side_by_side(neighbors.of_itself(grains), 25_000, torch.device("cpu"))
    now = {name: ms for name, (ms, _, _) in found.items() if ms is not None}
    names = [name for name in now if name != "kdtree"]
    return [
        (f"neighbors: {name} over kdtree", then["self", name] / then["self", "kdtree"], now[name] / now["kdtree"])
        for name in names
    ]


def of_requirements() -> list[tuple[str, float, float]]:
    rows = [("hopper_small", "reachable_points"), ("drum_small", "free_grains")]
    then = {(row["scene"], row["row"]): row["ms_with"] / row["ms_without"] for row in stored("requirements")}
    now: dict[tuple[str, str], float] = {}
    for scene in dict.fromkeys(scene for scene, _ in rows):
        now |= {(row["scene"], row["row"]): row["ms_with"] / row["ms_without"] for row in requirements.of_scene(scene)}
    return [(f"requirements: {' '.join(key)}, with over without", then[key], now[key]) for key in rows]


if __name__ == "__main__":
    main()

"""Neighbour searches side by side: `python -m benchmarks.neighbors [cpu|cuda]`.

Random points as dense as touching spheres of 10 mm, cutoff 25 mm: about ten neighbours. `self`: points that moved are
indexed and ask about themselves. `wall`: grains ask an index of a floor and a wall, points 10 mm apart, built before.
Backends take turns on one thread; medians go to benchmarks/results/neighbors.json, where other devices' rows stay.
nvalchemi-toolkit-ops, where it is installed, is measured as it is: unsorted, for one set alone.
"""

import json
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from math import pi
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from gns_pyg.graph.neighbors import BACKENDS, fixed_pairs, pairs
from gns_pyg.machine import processor

SIZES = (2_500, 25_000, 250_000, 1_000_000)
RADIUS_M, CUTOFF_M, PACKING = 0.01, 0.025, 0.6
ROUNDS = {2_500: 31, 25_000: 11, 250_000: 5, 1_000_000: 3}
LEFT_OUT = {  # (backend, device): the largest size, and why not beyond
    ("torch_cluster", "cuda"): (25_000, "quadratic: on CUDA it compares every point with every other"),
}
NOTES = {
    "grid, fixed room": "a set that asks about itself finds itself too",
    "nvalchemi": "unsorted; only a set that asks about itself",
}
OUT = Path(__file__).parent / "results" / "neighbors.json"
Search = Callable[[], Any]  # returns edges (2, e)


def main() -> None:
    torch.set_num_threads(1)
    device = torch.device(sys.argv[1] if len(sys.argv) > 1 else "cpu")
    machine = processor() if device.type == "cpu" else torch.cuda.get_device_name(device)
    rows = [row for row in json.loads(OUT.read_text()) if row["device"] != device.type] if OUT.exists() else []
    for n_points in SIZES:
        grains, walls = packing(n_points, device), box(n_points, device)
        for task, searches in (("self", of_itself(grains)), ("wall", of_walls(grains, walls))):
            measured = side_by_side(searches, n_points, device)
            for name, (ms, edges, note) in measured.items():
                row = {"device": device.type, "machine": machine, "backend": name, "points": n_points, "task": task}
                rows.append({**row, "ms": ms, "edges": edges, "note": note})
                print(json.dumps(rows[-1]), flush=True)
    OUT.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


def packing(n_points: int, device: torch.device) -> Tensor:
    """Random points in a cube, m, (n_points, 3)."""
    return side_m(n_points) * torch.rand(n_points, 3, generator=torch.Generator().manual_seed(0)).double().to(device)


def box(n_points: int, device: torch.device) -> Tensor:
    """Points of the cube's floor and of one wall, m, (n_walls, 3)."""
    line = torch.arange(0, side_m(n_points), RADIUS_M, dtype=torch.float64, device=device)
    zero = line.new_zeros(1)
    return torch.cat([torch.cartesian_prod(line, line, zero), torch.cartesian_prod(zero, line, line)])


def side_m(n_points: int) -> float:
    return (n_points * 4 / 3 * pi * RADIUS_M**3 / PACKING) ** (1 / 3)


def of_itself(pos: Tensor) -> dict[str, Search]:
    """Everything a step pays for: the points have moved since the last one."""
    same = torch.zeros(len(pos), dtype=torch.long, device=pos.device)
    found = {
        name: lambda build=b.build: pairs(build(pos, same))(pos, same, CUTOFF_M)
        for name, b in BACKENDS.items()
        if b.available(pos.device)
    }
    return {**found, "grid, fixed room": fixed(pos, pos), **nvalchemi(pos)}


def of_walls(pos: Tensor, walls: Tensor) -> dict[str, Search]:
    """The walls' index is built outside of what is timed."""
    same, same_wall = (torch.zeros(len(p), dtype=torch.long, device=pos.device) for p in (pos, walls))
    found = {}
    for name, b in BACKENDS.items():
        if b.available(pos.device):
            index = b.build(walls, same_wall)
            found[name] = lambda index=index: index(pos, same, CUTOFF_M)
    return {**found, "grid, fixed room": fixed(walls, pos)}


def fixed(points: Tensor, query: Tensor) -> Search:
    """`fixed_pairs` with a quarter more room than is needed."""
    same, same_query = (torch.zeros(len(p), dtype=torch.long, device=p.device) for p in (points, query))
    asked = points, same, query, same_query, CUTOFF_M
    _, _, n_candidates = fixed_pairs(*asked, 0, 0)
    room = int(1.25 * n_candidates)
    _, n_edges, _ = fixed_pairs(*asked, 0, room)
    room_edges = int(1.25 * n_edges)

    def search() -> Tensor:
        edges, _, _ = fixed_pairs(*asked, room_edges, room)
        return edges

    return search


def nvalchemi(pos: Tensor) -> dict[str, Search]:
    if find_spec("nvalchemiops") is None:
        return {}
    from nvalchemiops.torch.neighbors import neighbor_list

    cell = (side_m(len(pos)) + 3 * CUTOFF_M) * torch.eye(3, dtype=torch.float64, device=pos.device)
    periodic = torch.zeros(3, dtype=torch.bool, device=pos.device)
    room = {"max_neighbors": 64, "method": "cell_list", "return_neighbor_list": True}
    return {"nvalchemi": lambda: neighbor_list(pos, CUTOFF_M, cell=cell, pbc=periodic, **room)[0]}


def side_by_side(
    searches: dict[str, Search], n_points: int, device: torch.device
) -> dict[str, tuple[float | None, int | None, str]]:
    """Median milliseconds, edges and a note per backend; the first round warms up."""
    found: dict[str, tuple[float | None, int | None, str]] = {}
    timed: dict[str, list[float]] = {}
    edges: dict[str, int] = {}
    for name in searches:
        most, why = LEFT_OUT.get((name, device.type), (max(SIZES), ""))
        if n_points > most:
            found[name] = None, None, f"left out: {why}"
        else:
            timed[name] = []
    for number in range(-1, ROUNDS[n_points]):
        for name in timed if number % 2 else reversed(timed):
            wait(device)
            begin = time.perf_counter()
            result = searches[name]()
            wait(device)
            timed[name].append(1e3 * (time.perf_counter() - begin))
            edges[name] = int((result[1] < n_points).sum())  # without unused room
    for name, ms in timed.items():
        found[name] = round(median(ms[1:]), 3), edges[name], NOTES.get(name, "")
    return found


def wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def table(rows: list[dict[str, Any]]) -> str:
    """The results as Markdown, ms."""
    ms = {(r["device"], r["task"], r["backend"], r["points"]): r["ms"] for r in rows}
    head = ["device", "task", "backend", *(f"{n:,} points, ms" for n in SIZES)]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for device, task, name in dict.fromkeys(key[:3] for key in ms):
        values = (ms.get((device, task, name, n)) for n in SIZES)
        shown = (f"{value:,.1f}" if value is not None else "-" for value in values)
        lines.append(f"| {' | '.join([device, task, name, *shown])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

"""Who is within reach of whom: one contract, several backends.

A backend indexes a set of points once and answers queries against it:

    index = backend.build(points, point_batch)
    edges = index(query, query_batch, radius)    # [point, query] for every pair at most `radius` apart, same batch

`edges` is int64 (2, n_edges), sorted by query, then by point, complete: no backend drops a neighbour silently.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from math import inf, nextafter

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gns_pyg.errors import ConfigError, DependencyError, NumericalError

Index = Callable[[Tensor, Tensor, float], Tensor]


@dataclass(frozen=True)
class Backend:
    """One way to search. `build(points, point_batch)` returns the index described above."""

    name: str
    build: Callable[[Float[Tensor, "n 3"], Int[Tensor, " n"]], Index]
    cpu: bool
    cuda: Callable[[], bool]
    package: str | None = None

    def available(self, device: torch.device) -> bool:
        runs = self.cuda() if device.type == "cuda" else self.cpu
        return runs and (self.package is None or find_spec(self.package) is not None)


def backend(name: str, device: torch.device) -> Backend:
    """Finds a backend by name; `auto` takes the first that runs here, in the order of `BACKENDS`.

    Raises:
        ConfigError: for an unknown name.
        DependencyError: where the backend does not run on `device` or its package is not installed.
    """
    if name == "auto":
        return next(b for b in BACKENDS.values() if b.available(device))
    if name not in BACKENDS:
        raise ConfigError("model.neighbors", name, f"auto or one of {', '.join(BACKENDS)}", "pick one of them")
    chosen = BACKENDS[name]
    if not chosen.available(device):
        raise DependencyError(
            f"model.neighbors={name}",
            f"not available on {device.type}" + (f" (package {chosen.package})" if chosen.package else ""),
            "an installed backend that runs on this device",
            "set model.neighbors=auto" + (f" or install {chosen.package}" if chosen.package else ""),
        )
    return chosen


def pairs(index: Index) -> Index:
    """The same search without the pair that every point forms with itself; for a set that asks about itself."""

    def search(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        edges = index(query, query_batch, radius)
        return edges[:, edges[0] != edges[1]]

    return search


def _key(query: Tensor, point: Tensor, n_points: int) -> Tensor:
    """A pair as one number, so that sorting numbers sorts pairs: faster than an argsort of two."""
    return query << n_points.bit_length() | point


def _edges(key: Tensor, n_points: int) -> Tensor:
    """Sorted [point, query] of keys."""
    return _ends(key.sort().values, n_points)


def _ends(key: Tensor, n_points: int) -> Tensor:
    bits = n_points.bit_length()
    return torch.stack([key & (1 << bits) - 1, key >> bits])


def _kdtree(points: Tensor, point_batch: Tensor) -> Index:
    """SciPy's k-d tree, one per graph."""
    rows = _rows_per_graph(point_batch)

    def edges(keys: list[Tensor]) -> Tensor:  # NumPy sorts integers in a tenth of PyTorch's time
        return _ends(torch.from_numpy(np.sort(torch.cat(keys).numpy())), len(points))

    trees = {graph: cKDTree(points[where].numpy(), balanced_tree=False) for graph, where in rows.items()}

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        found = [query_batch.new_empty(0)]
        if query is points and query_batch is point_batch:  # each pair once, then the other way round: half the time
            for graph, where in rows.items():
                half = torch.from_numpy(trees[graph].query_pairs(radius, output_type="ndarray"))
                one, other = where[half.T]
                found += [_key(one, other, len(points)), _key(other, one, len(points)), _key(where, where, len(points))]
            return edges(found)
        for graph, where in _rows_per_graph(query_batch).items():
            if graph in trees:
                asking = cKDTree(query[where].numpy(), balanced_tree=False)
                near = trees[graph].sparse_distance_matrix(asking, radius, output_type="ndarray")
                point, row = (torch.from_numpy(near[end].copy()) for end in "ij")
                found.append(_key(where[row], rows[graph][point], len(points)))
        return edges(found)

    return index


def _rows_per_graph(batch: Tensor) -> dict[int, Tensor]:
    return {int(graph): torch.nonzero(batch == graph).flatten() for graph in batch.unique()}


X_BITS, X_STEPS = 26, 16  # of a key: the bits that hold x, in steps of 1/16 cell; a row's hash is above them
ROW_HASH = (7555532853418226689, 6189284837581902849, 5070092016526738433)  # y, z, graph: Roberts' R3 sequence * 2^63
SLACK = 1 + 2**-10  # cells are wider than the radius by more than a coordinate in cells is rounded
BLOCK = {"cpu": 2**14}  # queries asked at a time: on a CPU, about what its cache holds
BLOCK_ELSEWHERE = 2**20


@dataclass(frozen=True)
class Cells:
    """Points in rows of cells (y, z, graph) as wide as the radius, sorted by x within their row.

    Attributes:
        radius: reach of a search, m.
        key: hash of the row, then x; sorted, int64 (n,).
        point: the point in each place of that order, int64 (n,).
        pos: x, y, z and graph in each place (see `_apart`), (4, n).
        middle: an x amid the points, in cells, (); keys count from it.
    """

    radius: float
    key: Int[Tensor, " n"]
    point: Int[Tensor, " n"]
    pos: Float[Tensor, "4 n"]
    middle: Float[Tensor, ""]


def cells(points: Float[Tensor, "n 3"], point_batch: Int[Tensor, " n"], radius: float) -> Cells:
    """Sorts at least one point for searches within `radius`. Fixed shapes, no host synchronisation."""
    x, y, z = _in_cells(points, radius)
    sample = x[:: max(1, len(x) // 1024)].sort().values
    middle = sample[len(sample) // 2]  # not the smallest: a grain that escaped must not move it
    key, point = torch.sort(_row_key(y.floor().long(), z.floor().long(), point_batch) | _steps(x, middle))
    return Cells(radius, key, point, _apart(points, point_batch, radius)[:, point], middle)


def fixed_pairs(
    points: Float[Tensor, "n 3"],
    point_batch: Int[Tensor, " n"],
    query: Float[Tensor, "m 3"],
    query_batch: Int[Tensor, " m"],
    radius: float,
    capacity: int,
    candidate_capacity: int,
    hashed: Cells | None = None,
) -> tuple[Int[Tensor, "2 capacity"], Int[Tensor, ""], Int[Tensor, ""]]:
    """The grid's search in tensors of fixed size, without host synchronisation: a CUDA graph can hold it.

    Args:
        capacity, candidate_capacity: room for pairs, and for points looked at (about three times as many).
        hashed: `cells(points, point_batch, radius)`, where the points never move.

    Returns:
        [point, query] as the contract says, then [n, m] in unused places; the number of pairs, of candidates.
        A number beyond its capacity says that pairs are missing; of pairs, then, only those looked at are counted.
    """
    n, m = len(points), len(query)
    if n == 0 or m == 0:
        none = torch.zeros((), dtype=torch.long, device=query.device)
        return _edges(torch.full((capacity,), m << n.bit_length() | n, device=query.device), n), none, none
    hashed = cells(points, point_batch, radius) if hashed is None else hashed
    asking = _in_order(hashed, query, query_batch)
    query, query_batch = query[asking], query_batch[asking]
    first, count = _ranges(hashed, query, query_batch)
    row, point, near = _candidates(hashed, query, query_batch, first, count, candidate_capacity)
    key = _only(_key(asking[row], point, n), near, capacity, m << n.bit_length() | n)
    return _edges(key, n), near.sum(), count.sum()


def _grid(points: Tensor, point_batch: Tensor) -> Index:
    """Hashed uniform grid in plain torch, on any device: `fixed_pairs` with as much room as is needed."""

    @lru_cache(maxsize=2)
    def hashed(radius: float) -> Cells:
        return cells(points, point_batch, radius)

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        n, found = len(points), [query_batch.new_empty(0)]
        if n == 0 or len(query) == 0:
            return _edges(found[0], n)
        grid = hashed(radius)
        for asking in _in_order(grid, query, query_batch).split(BLOCK.get(query.device.type, BLOCK_ELSEWHERE)):
            asked = query[asking], query_batch[asking]
            first, count = _ranges(grid, *asked)
            row, point, near = _candidates(grid, *asked, first, count, int(count.sum()))
            found.append(_only(_key(asking[row], point, n), near, int(near.sum()), 0))
        return _edges(torch.cat(found), n)

    return index


def _in_cells(pos: Tensor, radius: float) -> tuple[Tensor, ...]:
    return (pos.double() / (radius * SLACK)).unbind(1)


def _apart(pos: Tensor, batch: Tensor, radius: float) -> Tensor:
    """x, y, z and a fourth coordinate that keeps graphs out of each other's reach, float64 (4, n)."""
    return torch.cat([pos.double().T, 2 * radius * batch.double()[None]])


def _row_key(y: Tensor, z: Tensor, graph: Tensor) -> Tensor:
    """A linear hash in the high bits: rows that may meet never share one, so no point is looked at twice."""
    return (y * ROW_HASH[0] + z * ROW_HASH[1] + graph * ROW_HASH[2]) & -(2**X_BITS)


def _steps(x: Tensor, middle: Tensor) -> Tensor:
    """x as the low bits of a key. Beyond what they hold all is one step: slower to search, as right."""
    half = 2 ** (X_BITS - 1)
    return ((x - middle) * X_STEPS).floor().clamp(-half, half - 1).long() + half


def _in_order(points: Cells, query: Tensor, query_batch: Tensor) -> Tensor:
    """Queries sorted as points are: those that follow each other read the same memory."""
    x, y, z = _in_cells(query, points.radius)
    return torch.argsort(_row_key(y.floor().long(), z.floor().long(), query_batch) | _steps(x, points.middle))


def _ranges(points: Cells, query: Tensor, query_batch: Tensor) -> tuple[Tensor, Tensor]:
    """First place and number of places to look at in the 9 rows around each query, clipped to its sphere, (m, 9)."""
    x, y, z = _in_cells(query, points.radius)
    side = torch.arange(-1, 2, device=query.device)
    rows_y, rows_z = (c.floor().long()[:, None] + side for c in (y, z))
    gap_y, gap_z = (  # to the near edge of each row, squared
        torch.stack([c - c.floor(), torch.zeros_like(c), 1 - (c - c.floor())], 1).square() for c in (y, z)
    )
    left = (1 - gap_y[:, :, None] - gap_z[:, None]).flatten(1)
    half = left.clamp(min=0).sqrt()
    row = _row_key(rows_y[:, :, None], rows_z[:, None], query_batch[:, None, None]).flatten(1)
    first = torch.searchsorted(points.key, row | _steps(x[:, None] - half, points.middle))
    last = torch.searchsorted(points.key, row | _steps(x[:, None] + half, points.middle), right=True)
    return first, (last - first) * (left >= 0)


def _candidates(
    points: Cells, query: Tensor, query_batch: Tensor, first: Tensor, count: Tensor, capacity: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Every row of `query` and point in its ranges, and whether they are a pair, each (capacity,)."""
    end = count.flatten().cumsum(0)
    start = end - count.flatten()
    opened = torch.zeros(capacity + 1, dtype=torch.long, device=query.device)
    opened.scatter_add_(0, start.clamp(max=capacity), torch.ones_like(start))
    number = opened[:-1].cumsum(0) - 1  # of the range that a slot belongs to
    slot = torch.arange(capacity, device=query.device)
    place = ((first.flatten() - start)[number] + slot).clamp(max=len(points.key) - 1)
    row = number // 9
    square = torch.zeros(capacity, dtype=torch.float64, device=query.device)
    for point_x, query_x in zip(points.pos, _apart(query, query_batch, points.radius), strict=True):
        square += (point_x[place] - query_x[row]).square()
    near = (square <= points.radius**2) & (slot < end[-1])
    return row, points.point[place], near


def _only(key: Tensor, near: Tensor, capacity: int, unused: int) -> Tensor:
    """The first `capacity` keys that are near, `unused` in the places left, (capacity,)."""
    at = (near.cumsum(0) - 1).masked_fill(~near, capacity).clamp(max=capacity)
    return torch.full((capacity + 1,), unused, device=key.device).scatter_(0, at, key)[:-1]


CLUSTER_LIMIT = 512


def _torch_cluster(points: Tensor, point_batch: Tensor) -> Index:
    """torch_cluster's radius search, built anew each time; it caps the neighbours; reaching the cap is an error."""
    from torch_cluster import radius as search

    points = points.double()  # it subtracts in the points' own precision

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        if len(points) == 0 or len(query) == 0:
            return torch.empty(2, 0, dtype=torch.long, device=query.device)
        within = nextafter(radius, inf)  # it wants less than this, not at most
        asking, point = search(
            points, query.double(), within, point_batch, query_batch, max_num_neighbors=CLUSTER_LIMIT
        )
        most = int(torch.bincount(asking).max()) if len(asking) else 0
        if most >= CLUSTER_LIMIT:
            raise NumericalError(
                "neighbour search (torch_cluster)",
                f"a point with at least {most} neighbours",
                f"fewer than {CLUSTER_LIMIT}",
                "lower the cutoff or set model.neighbors=grid, which has no limit",
            )
        return _edges(_key(asking, point, len(points)), len(points))

    return index


def _torch_cluster_has_cuda() -> bool:
    """torch_cluster may be installed without its CUDA kernels."""
    if find_spec("torch_cluster") is None:
        return False
    import torch_cluster  # noqa: F401  registers the operator asked for here

    return torch.ops.torch_cluster.cuda_version() >= 0


# Fastest first. On a CPU the k-d tree leads at every size, self and wall search taken together, and torch_cluster falls
# behind the grid beyond 25,000 points (benchmarks/results/neighbors.json). On CUDA (not measured), the grid is first:
# its work grows with the points, torch_cluster's with their square.
BACKENDS = {
    b.name: b
    for b in (
        Backend("kdtree", _kdtree, cpu=True, cuda=lambda: False),
        Backend("grid", _grid, cpu=True, cuda=lambda: True),
        Backend("torch_cluster", _torch_cluster, cpu=True, cuda=_torch_cluster_has_cuda, package="torch_cluster"),
    )
}

"""Who is within reach of whom: one contract, several backends.

A backend indexes a set of points once and answers queries against it:

    index = backend.build(points, point_batch)
    edges = index(query, query_batch, radius)    # [point, query] for every pair at most `radius` apart, same batch

`edges` is int64 (2, n_edges), sorted by query, then by point, complete: no backend drops a neighbour silently.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

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


def _sorted(edges: Tensor, n_points: int) -> Tensor:
    return edges[:, torch.argsort(edges[1] * n_points + edges[0])]


def _kdtree(points: Tensor, point_batch: Tensor) -> Index:
    """SciPy's k-d tree, one per graph."""
    rows = _rows_per_graph(point_batch)
    trees = {graph: cKDTree(points[where].numpy()) for graph, where in rows.items()}

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        found = [torch.empty(2, 0, dtype=torch.long)]
        for graph, where in _rows_per_graph(query_batch).items():
            if graph in trees:
                other = cKDTree(query[where].numpy())
                near = trees[graph].sparse_distance_matrix(other, radius, output_type="ndarray")
                point, asking = torch.from_numpy(near["i"].copy()), torch.from_numpy(near["j"].copy())
                found.append(torch.stack([rows[graph][point], where[asking]]))
        return _sorted(torch.cat(found, 1), len(points))

    return index


def _rows_per_graph(batch: Tensor) -> dict[int, Tensor]:
    return {int(graph): torch.nonzero(batch == graph).flatten() for graph in batch.unique()}


OFFSETS = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
PRIMES = (73856093, 19349663, 83492791, 67867979)  # spatial hash of Teschner et al. 2003, one more for the graph


def _grid(points: Tensor, point_batch: Tensor) -> Index:
    """Hashed uniform grid in plain torch, on any device: cells as wide as the radius, 27 of them searched."""

    def hashed(cell: Tensor, batch: Tensor) -> Tensor:
        key = batch * PRIMES[3]
        for axis in range(3):
            key = key ^ (cell[:, axis] * PRIMES[axis])
        return key

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        cell = torch.floor(points / radius).long()
        key, order = torch.sort(hashed(cell, point_batch))
        found = []
        for offset in OFFSETS.to(points.device):
            wanted = torch.floor(query / radius).long() + offset
            wanted_key = hashed(wanted, query_batch)
            first = torch.searchsorted(key, wanted_key)
            count = torch.searchsorted(key, wanted_key, right=True) - first
            asking = torch.repeat_interleave(torch.arange(len(query), device=query.device), count)
            place = torch.arange(len(asking), device=query.device) - torch.repeat_interleave(
                count.cumsum(0) - count, count
            )
            point = order[first[asking] + place]
            same_cell = (cell[point] == wanted[asking]).all(1)  # two cells may share a key
            near = (points[point] - query[asking]).square().sum(1) <= radius**2
            keep = same_cell & near & (point_batch[point] == query_batch[asking])
            found.append(torch.stack([point[keep], asking[keep]]))
        return _sorted(torch.cat(found, 1), len(points))

    return index


CLUSTER_LIMIT = 512


def _torch_cluster(points: Tensor, point_batch: Tensor) -> Index:
    """torch_cluster's radius search. It caps the neighbours of a query; reaching the cap is an error here."""
    from torch_cluster import radius as search

    def index(query: Tensor, query_batch: Tensor, radius: float) -> Tensor:
        if len(points) == 0 or len(query) == 0:
            return torch.empty(2, 0, dtype=torch.long, device=query.device)
        asking, point = search(points, query, radius, point_batch, query_batch, max_num_neighbors=CLUSTER_LIMIT)
        most = int(torch.bincount(asking).max()) if len(asking) else 0
        if most >= CLUSTER_LIMIT:
            raise NumericalError(
                "neighbour search (torch_cluster)",
                f"a point with at least {most} neighbours",
                f"fewer than {CLUSTER_LIMIT}",
                "lower the cutoff or set model.neighbors=grid, which has no limit",
            )
        return _sorted(torch.stack([point, asking]), len(points))

    return index


def _torch_cluster_has_cuda() -> bool:
    """torch_cluster may be installed without its CUDA kernels."""
    if find_spec("torch_cluster") is None:
        return False
    import torch_cluster  # noqa: F401  registers the operator asked for here

    return torch.ops.torch_cluster.cuda_version() >= 0


BACKENDS = {
    b.name: b
    for b in (
        Backend("kdtree", _kdtree, cpu=True, cuda=lambda: False),
        Backend("torch_cluster", _torch_cluster, cpu=True, cuda=_torch_cluster_has_cuda, package="torch_cluster"),
        Backend("grid", _grid, cpu=True, cuda=lambda: True),
    )
}

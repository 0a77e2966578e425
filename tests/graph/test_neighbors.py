"""Every backend against brute force."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_pyg.errors import ConfigError, DependencyError
from gns_pyg.graph.neighbors import BACKENDS, backend, pairs

CPU = torch.device("cpu")


def reason(name):
    return pytest.mark.skipif(
        not BACKENDS[name].available(CPU), reason=f"{name}: package {BACKENDS[name].package} is not installed"
    )


every_backend = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[reason(name), *([pytest.mark.torch_cluster] if name == "torch_cluster" else [])])
        for name in BACKENDS
    ],
)


def brute_force(points, point_batch, query, query_batch, radius):
    distance = torch.cdist(query, points, compute_mode="donot_use_mm_for_euclid_dist")
    near = (distance <= radius) & (query_batch[:, None] == point_batch[None])
    asking, point = near.nonzero(as_tuple=True)
    return torch.stack([point, asking])


def cloud(n, n_graphs, seed, scale=1.0):
    random = torch.Generator().manual_seed(seed)
    pos = scale * torch.rand(n, 3, generator=random, dtype=torch.float64)
    return pos, torch.randint(n_graphs, (n,), generator=random).sort().values


@every_backend
@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(0, 120),
    m=st.integers(0, 60),
    n_graphs=st.integers(1, 3),
    seed=st.integers(0, 10**6),
    radius=st.sampled_from([0.05, 0.2, 0.6]),
    shift=st.sampled_from([0.0, -3.0, 1e5]),
)
def test_equals_brute_force(name, n, m, n_graphs, seed, radius, shift):
    points, point_batch = cloud(n, n_graphs, seed)
    query, query_batch = cloud(m, n_graphs, seed + 1)
    points, query = points + shift, query + shift
    edges = BACKENDS[name].build(points, point_batch)(query, query_batch, radius)
    assert torch.equal(edges, brute_force(points, point_batch, query, query_batch, radius))


@every_backend
def test_single_and_isolated_grains_have_no_pairs(name):
    for pos in (torch.zeros(1, 3), 5.0 * torch.eye(3)):
        pos, batch = pos.double(), torch.zeros(len(pos), dtype=torch.long)
        edges = pairs(BACKENDS[name].build(pos, batch))(pos, batch, 1.0)
        assert edges.shape == (2, 0)
        assert edges.dtype == torch.long


@every_backend
def test_no_neighbour_is_dropped_in_a_crowd(name):
    pos = 1e-3 * cloud(400, 1, 0)[0]
    batch = torch.zeros(400, dtype=torch.long)
    assert pairs(BACKENDS[name].build(pos, batch))(pos, batch, 1.0).shape[1] == 400 * 399


@every_backend
def test_far_outlier_does_not_disturb(name):
    pos, batch = cloud(50, 1, 3)
    pos[-1] = torch.tensor([1e7, -1e7, 1e7])
    edges = pairs(BACKENDS[name].build(pos, batch))(pos, batch, 0.3)
    expected = brute_force(pos, batch, pos, batch, 0.3)
    assert torch.equal(edges, expected[:, expected[0] != expected[1]])


def test_unknown_backend_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="kdtree"):
        backend("octree", CPU)


def test_a_backend_that_cannot_run_here_is_refused():
    with pytest.raises(DependencyError, match="auto"):
        backend("kdtree", torch.device("cuda"))


@pytest.mark.torch_cluster
@reason("torch_cluster")
def test_reaching_the_cap_of_torch_cluster_is_an_error():
    from gns_pyg.errors import NumericalError

    pos, batch = torch.zeros(600, 3, dtype=torch.float64), torch.zeros(600, dtype=torch.long)
    with pytest.raises(NumericalError, match="600|512"):
        BACKENDS["torch_cluster"].build(pos, batch)(pos, batch, 1.0)

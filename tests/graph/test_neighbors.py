"""Every backend against brute force."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from gns_pyg.errors import ConfigError, DependencyError
from gns_pyg.graph.neighbors import BACKENDS, ROW_HASH, X_BITS, backend, cells, fixed_pairs, pairs

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
    shift=st.sampled_from([0.0, -3.0, 1e6]),
)
def test_equals_brute_force(name, n, m, n_graphs, seed, radius, shift):
    points, point_batch = cloud(n, n_graphs, seed)
    query, query_batch = cloud(m, n_graphs, seed + 1)
    points, query = points + shift, query + shift
    index = BACKENDS[name].build(points, point_batch)
    assert torch.equal(index(query, query_batch, radius), brute_force(points, point_batch, query, query_batch, radius))
    itself = points, point_batch
    assert torch.equal(index(*itself, radius), brute_force(*itself, *itself, radius))


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


@every_backend
@pytest.mark.parametrize("shift", [0.0, -1e6])
def test_float32_is_searched_like_the_same_numbers_in_float64(name, shift):
    pos, batch = cloud(200, 2, 5, scale=8.0)
    pos = (pos + shift).float()
    edges = BACKENDS[name].build(pos, batch)(pos, batch, 1.5)
    assert torch.equal(edges, brute_force(pos.double(), batch, pos.double(), batch, 1.5))


@every_backend
def test_one_index_answers_for_several_radii(name):
    pos, batch = cloud(80, 2, 1)
    index = BACKENDS[name].build(pos, batch)
    for radius in (0.1, 0.3, 0.2, 0.1):
        assert torch.equal(index(pos, batch, radius), brute_force(pos, batch, pos, batch, radius))


@every_backend
def test_a_lattice_of_exactly_the_radius_is_connected(name):
    pos = torch.cartesian_prod(*[torch.arange(-3.0, 4.0, dtype=torch.float64) / 4] * 3)
    batch = torch.zeros(len(pos), dtype=torch.long)
    edges = BACKENDS[name].build(pos, batch)(pos, batch, 0.25)
    assert torch.equal(edges, brute_force(pos, batch, pos, batch, 0.25))


def test_an_escaped_grain_does_not_make_others_candidates():
    pos, batch = cloud(3000, 1, 4)
    for far in (-1e9, 1e9):
        away = torch.cat([torch.full((1, 3), far, dtype=torch.float64), pos])
        none = torch.zeros(3001, dtype=torch.long)
        few = int(fixed_pairs(pos, batch, pos, batch, 0.05, 0, 0)[2])
        assert int(fixed_pairs(away, none, away, none, 0.05, 0, 0)[2]) <= few + 50


def test_rows_around_a_cell_never_share_a_hash():
    for y, z in torch.cartesian_prod(torch.arange(-2, 3), torch.arange(-2, 3)).tolist():
        difference = (y * ROW_HASH[0] + z * ROW_HASH[1]) % 2**64
        assert (y, z) == (0, 0) or 2**X_BITS < difference < 2**64 - 2**X_BITS


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(0, 120),
    m=st.integers(0, 60),
    n_graphs=st.integers(1, 3),
    seed=st.integers(0, 10**6),
    capacity=st.integers(0, 3000),
    candidate_capacity=st.integers(0, 3000),
)
def test_fixed_pairs_are_the_pairs_or_their_counts_say_otherwise(n, m, n_graphs, seed, capacity, candidate_capacity):
    asked = *cloud(n, n_graphs, seed), *cloud(m, n_graphs, seed + 1)
    expected = brute_force(*asked, 0.3)
    edges, n_edges, n_candidates = fixed_pairs(*asked, 0.3, capacity, candidate_capacity)
    assert edges.shape == (2, capacity)
    assert n_candidates >= expected.shape[1]
    if n_candidates <= candidate_capacity:
        assert n_edges == expected.shape[1]
    used = min(int(n_edges), capacity)
    assert torch.equal(edges[:, used:], torch.tensor([[n], [m]]).expand(2, capacity - used))
    if n_candidates <= candidate_capacity and n_edges <= capacity:
        assert torch.equal(edges[:, :used], expected)
    else:
        assert {tuple(pair) for pair in edges[:, :used].T.tolist()} <= {tuple(pair) for pair in expected.T.tolist()}


class Capturable(TorchDispatchMode):
    """Refuses what a CUDA graph cannot hold: shapes that depend on values, values read or copied by the host."""

    REFUSED = ("nonzero", "unique", "masked_select", "local_scalar", "lift_fresh", "bincount")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        indices = args[1] if name in ("index", "index_put", "index_put_") else ()
        counted = name == "repeat_interleave" and (kwargs or {}).get("output_size") is None
        masked = any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in indices)
        if any(refused in name for refused in self.REFUSED) or counted or masked:
            raise AssertionError(f"{func} in a step that is to be captured")
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_fixed_pairs_never_wait_for_the_host(dtype):
    pos, batch = cloud(100, 2, 7)
    hashed = cells(pos.to(dtype), batch, 0.3)
    with Capturable():
        for known in (None, hashed):
            edges, n_edges, _ = fixed_pairs(pos.to(dtype), batch, pos.to(dtype), batch, 0.3, 4000, 10000, known)
    expected = brute_force(pos.to(dtype).double(), batch, pos.to(dtype).double(), batch, 0.3)
    assert torch.equal(edges[:, : int(n_edges)], expected)


def test_the_check_for_captures_sees_what_it_should():
    values = torch.arange(3)
    for bad in (lambda: values[values > 1], lambda: values.unique(), lambda: int(values[0]), lambda: torch.tensor(1)):
        with Capturable(), pytest.raises(AssertionError, match="captured"):
            bad()


def test_auto_follows_what_was_measured():
    assert backend("auto", CPU).name == "kdtree"
    assert backend("auto", torch.device("cuda")).name == "grid"


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

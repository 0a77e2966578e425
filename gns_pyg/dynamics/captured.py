"""A simulator's step in tensors of fixed size, which a GPU replays as one CUDA graph without waiting for the host.

Edges have capacities. Unused places hold loops on one more grain and boundary point that are nobody's. What a step
would have needed is counted; if it is more than there is room for, the capacities grow and the step is done again.
"""

from collections.abc import Iterator
from dataclasses import fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gns_pyg.config import require
from gns_pyg.dynamics.free_grains import can_touch
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.graph.neighbors import cells, fixed_pairs
from gns_pyg.state import Graph, State, Walls, constant

SLACK = 1.25  # room beyond what the last overflow needed
WARM_UP = 3  # steps before a capture, as CUDA graphs ask for


class Captured:
    """The step of `simulator`, called like it. Tested on the CPU, where nothing is captured; not yet run on a GPU.

    Attributes:
        capacities: for the grains' search and then for each boundary part's: edges, candidates.
    """

    def __init__(self, simulator: Simulator) -> None:
        sweeps, expected = simulator.config.projection_sweeps, "a model without projection"
        require(not sweeps, "execution.capture", f"true, projection_sweeps = {sweeps}", expected, "set it to false")
        self.simulator = simulator
        self.parts = list(simulator.boundary or ())
        self.capacities = [1] * 2 * (1 + len(self.parts))
        self._hashed = [cells(part.pos, _one_graph(part.pos), part.cutoff_m) for part in self.parts]
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, state: State) -> State:
        while True:
            after, needed = self._replay(state) if state.pos.is_cuda else self.step(state)
            needs = needed.tolist()  # the step's only wait for the device
            if all(need <= room for need, room in zip(needs, self.capacities, strict=True)):
                return self.simulator.guarded(state, after)
            grown = [
                room if need <= room else int(SLACK * need) + 1
                for need, room in zip(needs, self.capacities, strict=True)
            ]
            self.capacities, self._graph = grown, None

    def _replay(self, state: State) -> tuple[State, Tensor]:
        if self._graph is None or _shapes(self._input) != _shapes(state):
            self._capture(state)
        for name in _tensors(state):
            getattr(self._input, name).copy_(getattr(state, name))
        assert self._graph is not None
        self._graph.replay()
        after, needed = self._output
        return replace(after, **{name: getattr(after, name).clone() for name in _tensors(after)}), needed

    def _capture(self, state: State) -> None:
        self._input = replace(state, **{name: getattr(state, name).clone() for name in _tensors(state)})
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARM_UP):
                self.step(self._input)
        torch.cuda.current_stream().wait_stream(side)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._output = self.step(self._input)

    def step(self, state: State) -> tuple[State, Int[Tensor, " n_capacities"]]:
        """The next state, as `Simulator.advance` gives it, and the capacities it would have needed: right only if they
        are no more than there were."""
        graph, needed = self.graph(state)
        correction = self.simulator.effects(_one_more(state), graph)[:-1]
        if state.active is not None:
            correction = torch.where(state.active[:, None], correction, 0.0)
        return self.simulator.advance(state, correction), needed

    def graph(self, state: State) -> tuple[Graph, Int[Tensor, " n_capacities"]]:
        """As `Simulator.graph`, with edges that are left out turned to loops on the grain that is nobody's."""
        simulator, everyone, n = self.simulator, _one_more(state), len(state.pos)
        rooms = iter(self.capacities)
        edges, *needed = fixed_pairs(
            state.pos, state.batch, state.pos, state.batch, simulator.cutoff_m, next(rooms), next(rooms)
        )
        kept = torch.ones_like(edges[0], dtype=torch.bool)
        if simulator.pairs_once:
            kept = edges[0] < edges[1]
        elif not simulator.config.self_loops:
            kept = edges[0] != edges[1]
        if len(simulator.scene.grains.radii_m) > 1:
            kept = kept & simulator.in_reach(everyone, edges)
        walls, contacts = None, edges[:, :0]
        if simulator.boundary is not None:
            walls, contacts, more = self._contacts(state, everyone, rooms)
            needed += more
        nobody, nothing = constant((n, n), edges), constant((0 if walls is None else len(walls.pos) - 1, n), edges)
        graph = Graph(_only(edges, kept, nobody), contacts, walls)
        near = torch.ones_like(everyone.batch, dtype=torch.bool) if everyone.active is None else everyone.active
        graph = _among(graph, near, nobody, nothing)
        if simulator.requires.free_grains:
            meet, meet_wall = simulator.near(everyone, graph)
            if simulator.requires.touching_pairs:
                pairs, contacts = _only(graph.grain_edges, meet, nobody), _only(graph.wall_edges, meet_wall, nothing)
                graph = Graph(pairs, contacts, walls)
            else:
                graph = _among(graph, can_touch(graph, meet, meet_wall, n + 1), nobody, nothing)
        return graph, torch.stack(needed)

    def _contacts(
        self, state: State, everyone: State, rooms: Iterator[int]
    ) -> tuple[Walls, Int[Tensor, "2 e"], list[Tensor]]:
        n, device = len(state.pos), state.pos.device
        placed: list[Walls] = []
        found, needed, first = [], [], []
        for part, hashed in zip(self.parts, self._hashed, strict=True):
            n_points, body_pos = len(part.pos), part.body_pos(state)
            asked = (part.pos, _one_graph(part.pos), body_pos, _one_graph(body_pos), part.cutoff_m)
            edges, *need = fixed_pairs(*asked, next(rooms), next(rooms), hashed)
            point, grain = edges
            kept = grain < n
            if len(part.radii_m) > 1:
                ends = torch.stack([point.clamp(max=n_points - 1), grain.clamp(max=n - 1)])
                kept = kept & part.in_reach(body_pos, state.radius, ends)
            if part.nearest:
                ends = torch.stack([point.clamp(max=n_points - 1), grain.clamp(max=n)])
                kept = kept & part.nearest_on_plane(torch.cat([body_pos, body_pos[:1]]), ends)
            rows = torch.arange(state.n_graphs * n_points, device=device)
            first.append(sum(len(each.pos) for each in placed))
            placed.append(part.at(rows % n_points, state.time_s[rows // n_points]))
            found.append((kept, everyone.batch[grain] * n_points + point, grain))
            needed += need
        zero = state.pos.new_zeros(1)
        nowhere = Walls(zero.expand(1, 3), constant((0.0, 0.0, 1.0), zero)[None], zero.expand(1, 3), zero)
        walls = Walls.join([*placed, nowhere])
        nothing = constant((len(walls.pos) - 1, n), state.batch)
        contacts = [
            _only(torch.stack([row + start, grain]), kept, nothing)
            for start, (kept, row, grain) in zip(first, found, strict=True)
        ]
        return walls, torch.cat(contacts, 1), needed


def _tensors(state: State) -> list[str]:
    return [field.name for field in fields(state) if getattr(state, field.name) is not None]


def _shapes(state: State) -> dict[str, torch.Size]:
    return {name: getattr(state, name).shape for name in _tensors(state)}


def _one_graph(pos: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    return torch.zeros(len(pos), dtype=torch.long, device=pos.device)


def _one_more(state: State) -> State:
    """With one more grain, at the origin and at rest, of the last graph."""

    def longer(values: Tensor, value: float) -> Tensor:
        return torch.cat([values, values.new_full((1, *values.shape[1:]), value)])

    last = {"radius": 1.0, "batch": float(state.n_graphs - 1)}
    own = [name for name in _tensors(state) if name not in ("time_s", "parameters")]
    return replace(state, **{name: longer(getattr(state, name), last.get(name, 0.0)) for name in own})


def _only(edges: Int[Tensor, "2 e"], kept: Bool[Tensor, " e"], nothing: Int[Tensor, " 2"]) -> Int[Tensor, "2 e"]:
    return torch.where(kept, edges, nothing[:, None])


def _among(graph: Graph, grains: Bool[Tensor, " n"], nobody: Tensor, nothing: Tensor) -> Graph:
    sender, receiver = graph.grain_edges
    return Graph(
        _only(graph.grain_edges, grains[sender] & grains[receiver], nobody),
        _only(graph.wall_edges, grains[graph.wall_edges[1]], nothing),
        graph.walls,
    )

"""State in, next state out: the only code that training, roll-out and evaluation share."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from gns_pyg.config import require
from gns_pyg.dynamics import memory
from gns_pyg.dynamics.boundary import Boundary
from gns_pyg.dynamics.execution import Execution
from gns_pyg.dynamics.free_grains import MARGIN_RADII, among, can_meet, can_touch, meeting, pair_margin_m
from gns_pyg.dynamics.guard import Guard
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.passage import Passage
from gns_pyg.dynamics.projection import separated
from gns_pyg.dynamics.rest import REST, REST_AFTER_CREEP, rested
from gns_pyg.dynamics.tiles import tiles
from gns_pyg.graph import contacts, features
from gns_pyg.graph.neighbors import backend, pairs
from gns_pyg.models.contact_network import ContactNetwork
from gns_pyg.models.impulse_network import GAINED, MEAN, VELOCITY, Damping, Grains, ImpulseNetwork, exchange
from gns_pyg.models.mlp import mlp
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints
from gns_pyg.scene.free_flight import cundall
from gns_pyg.scene.requirements import Requirements
from gns_pyg.scene.scene import PARAMETERS, Scene
from gns_pyg.state import Graph, State, Walls, constant, reached

FARTHEST = 20.0  # standard deviations of the training cases' positions


class Simulator(nn.Module):
    """Two contact networks, one for grain-grain and one for grain-boundary contact, and the integrator.

    Args:
        scene: what is simulated; gives gravity, damping, frame step and the walls' motion.
        config: the model's choices.
        requires: what the scene requires; nothing else is built.
        points: boundary points of each part, body frame.
        statistics: scales of the training data.
    """

    scale: Tensor

    def __init__(
        self,
        scene: Scene,
        config: ModelConfig,
        requires: Requirements,
        points: Mapping[str, BoundaryPoints],
        statistics: Statistics,
    ) -> None:
        super().__init__()
        self.scene, self.config, self.requires, self.statistics = scene, config, requires, statistics
        options: dict[str, Any] = dict(free_flight=requires.free_flight, memory=config.memory)
        self.integrator = Integrator(scene, requires.state, **options)
        scale = torch.tensor(statistics.correction).repeat_interleave(3)
        self.register_buffer("scale", scale, persistent=False)
        self.execution = Execution()
        self.edges_done = 0  # edges that went through the networks so far
        pairs_alone = requires.touching_pairs and config.self_loops
        loops = "false where only pairs that can touch are edges"
        require(not pairs_alone, "model.self_loops", "true", loops, "set requires.touching_pairs=false")
        self._conditions = [PARAMETERS.index(name) for name in requires.material_features]

        self.boundary: Boundary | None = None
        if requires.wall_network:
            walls = dict(static=requires.static_walls, nearest=requires.nearest_points)
            self.boundary = Boundary(scene, points, config, reachable=requires.reachable_points, **walls)
        self.grain_network: ContactNetwork | ImpulseNetwork
        self.wall_network: ContactNetwork | ImpulseNetwork | None = None
        if config.network == "impulse":
            self._build_impulse_networks()
        else:
            self._build_message_networks()
        self.passage = Passage(scene) if requires.active_mask else None
        self.guard = Guard(scene)

    def _build_message_networks(self) -> None:
        config, requires = self.config, self.requires
        width: dict[str, Any] = dict(
            n_out=3 * self.integrator.n_groups,
            hidden=config.hidden,
            layers=config.layers,
            mlp_layers=config.mlp_layers,
            skip=config.skip,
        )
        n_position = 3 * config.absolute_position
        n_grain = 3 + 3 * (requires.state == "full") + requires.radius_features + len(self._conditions) + n_position
        n_edge = features.n_grain_edge_features(config.contact_features)
        self.grain_network = ContactNetwork(n_sender=None, n_receiver=n_grain, n_edge=n_edge, **width)
        if requires.wall_network:
            n_point = 3 + 3 * requires.wall_velocity + requires.wall_friction + n_position
            n_edge = features.n_wall_edge_features(config.contact_features)
            self.wall_network = ContactNetwork(
                n_sender=n_point, n_receiver=n_grain, n_edge=n_edge, sparse=requires.reachable_points, **width
            )

    def _build_impulse_networks(self) -> None:
        config, requires = self.config, self.requires
        known = "true: impulses are what contacts add to free flight"
        require(
            requires.free_flight, "requires.free_flight", "false with model.network=impulse", known, "set it to auto"
        )
        moving = config.memory and any(part.motion.moves for part in self.scene.boundary.values())
        require(not moving, "model.memory", config.memory, "0 in a scene whose walls move", "set model.memory=0")
        width = {key: getattr(config, key) for key in ("hidden", "layers", "mlp_layers", "channels")}
        width["memory"] = bool(config.memory)
        n_grain = 2 + requires.radius_features + len(self._conditions)
        self.encode_grain = mlp(n_grain, config.hidden, config.hidden, config.mlp_layers, layer_norm=True)
        n_scalar, n_basis = contacts.N_SCALARS, contacts.N_BASIS
        self.grain_network = ImpulseNetwork(n_scalar=n_scalar, n_basis=n_basis, mutual=True, **width)
        if requires.damped:
            self.damping = Damping(config.hidden, config.channels)
        if requires.wall_network:
            n_scalar, n_basis = contacts.N_WALL_SCALARS + requires.wall_friction, contacts.N_WALL_BASIS
            self.wall_network = ImpulseNetwork(n_scalar=n_scalar, n_basis=n_basis, mutual=False, **width)

    def forward(self, state: State) -> State:
        """Moves every grain by one frame."""
        return self.guarded(state, self.advance(state, self.correction(state)))

    def advance(self, state: State, correction: Float[Tensor, "n_grains d"]) -> State:
        """The next state, given what contacts add, as if no grain could go through a wall."""
        after = self.integrator.integrate(state, correction * self.scale)
        if self.config.projection_sweeps:
            after = self._separated(state, after)
        if self.requires.rest:
            after = rested(state, after, self.integrator.gained(state), self.scene.frame_dt_s, self._rest)
        return after if self.passage is None else self.passage(state, after)

    def guarded(self, before: State, after: State) -> State:
        """`after`, without what went through a wall (see `guard`), and with what grains remember."""
        held = self.guard(before, after)
        if self.requires.state == "differences" and held is not after:
            held = replace(held, vel=(held.pos - before.pos) / self.scene.frame_dt_s)
        if steps := self.config.memory:
            still_m_s = self._rest * self.integrator.gained(before)
            held = memory.remembered(before, held, steps, self.scene.frame_dt_s, still_m_s)
        return held

    @property
    def _rest(self) -> float:
        """See `dynamics.rest`."""
        return REST_AFTER_CREEP if self.config.memory else REST

    def _separated(self, state: State, after: State) -> State:
        there = after if after.active is None else replace(after.pick(after.active), active=None)
        where = there.pos.detach()
        search = pairs(backend(self.config.neighbors, where.device).build(where, there.batch))
        close = search(where, there.batch, 2 * max(self.scene.grains.radii_m))
        walls, contacts = (None, close[:, :0]) if self.boundary is None else self.boundary.contacts(there)
        apart = separated(there, close, walls, contacts, self.config.projection_sweeps)
        if after.active is not None:
            rows = after.active[:, None]
            pos, vel = after.pos.masked_scatter(rows, apart.pos), after.vel.masked_scatter(rows, apart.vel)
            apart = replace(after, pos=pos, vel=vel)
        if self.requires.state == "differences":
            apart = replace(apart, vel=(apart.pos - state.pos) / self.scene.frame_dt_s)
        return apart

    def target(self, state: State, following: State) -> Float[Tensor, "n_grains d"]:
        """The value of `correction` that takes `state` to `following`; what training aims at."""
        return (self.integrator.target(state, following) / self.scale).to(self.scale.dtype)

    def correction(self, state: State) -> Float[Tensor, "n_grains d"]:
        """What contacts add, over `scale`; 0 for a grain that is not active."""
        if state.active is None:
            return self._contacts(state)
        there = self._contacts(replace(state.pick(state.active), active=None))
        return there.new_zeros(len(state.pos), there.shape[1]).masked_scatter(state.active[:, None], there)

    def _contacts(self, state: State) -> Float[Tensor, "n_grains d"]:
        most = self.execution.tile_grains
        if most is None or len(state.pos) <= most:
            return self.effects(state, self.graph(state))
        total = self.scale.new_empty(len(state.pos), len(self.scale))
        for core, region in tiles(state.pos.detach(), most, self.halo_m):
            near = state.pick(region)
            total[core] = self.effects(near, self.graph(near))[torch.searchsorted(region, core)]
        return total

    def effects(self, state: State, graph: Graph) -> Float[Tensor, "n_grains d"]:
        """What the contacts of `graph` add, over `scale`; 0 for a grain without an edge."""
        self.edges_done += graph.grain_edges.shape[1] + graph.wall_edges.shape[1]
        where, cast = self.scale.device.type, self.execution.autocast
        with torch.autocast(where, cast) if cast else nullcontext():
            return self._impulses(state, graph) if self.config.network == "impulse" else self._messages(state, graph)

    def _messages(self, state: State, graph: Graph) -> Float[Tensor, "n_grains d"]:
        """The paper's equation (10): the sum of two networks."""
        grains = self._grain_features(state)
        options: dict[str, Any] = dict(
            velocity_m_s=self.statistics.velocity_m_s,
            dt_s=self.scene.frame_dt_s,
            contact=self.config.contact_features,
            dtype=self.scale.dtype,
        )
        edges = features.grain_edges(state, graph, **options)
        total = self.grain_network(None, grains, edges, graph.grain_edges).to(self.scale.dtype)
        if self.wall_network is not None and graph.walls is not None:
            edges = features.wall_edges(state, graph, graph.walls, **options)
            points = self._wall_features(graph.walls)
            total = total + self.wall_network(points, grains, edges, graph.wall_edges).to(self.scale.dtype)
        return total

    def _impulses(self, state: State, graph: Graph) -> Float[Tensor, "n_grains d"]:
        """Two networks that take turns on the same grains, from what these would do under gravity alone."""
        velocity_m_s, dtype, dt_s = self.statistics.velocity_m_s, self.scale.dtype, self.scene.frame_dt_s
        free_vel = state.vel + constant(self.scene.gravity_m_s2, state.vel) * dt_s
        options: dict[str, Any] = dict(velocity_m_s=velocity_m_s, dt_s=dt_s, dtype=dtype)
        slow_m_s = contacts.FINE * self.scene.grains.radii_m[0] / dt_s
        options["slow"] = slow = slow_m_s / velocity_m_s
        if self.config.memory:
            options["drift"] = memory.of_slow(state, slow_m_s)
        grains = self._grains(state, free_vel)
        unlike = len(self.scene.grains.radii_m) > 1
        assert isinstance(self.grain_network, ImpulseNetwork)
        kinds = [(self.grain_network, contacts.grain_contacts(state, free_vel, graph, unlike=unlike, **options))]
        if isinstance(self.wall_network, ImpulseNetwork) and graph.walls is not None:
            options |= dict(friction=self.requires.wall_friction, moving=self.requires.wall_velocity)
            kinds.append((self.wall_network, contacts.wall_contacts(state, free_vel, graph, graph.walls, **options)))
        after = exchange(grains, kinds)
        vel, spin = (after.motion - grains.motion).unbind(1)
        groups = [vel[:, :, MEAN], vel[:, :, VELOCITY], spin[:, :, VELOCITY] + spin[:, :, MEAN]]
        if self.requires.damped:
            groups = self._damped(state, free_vel, graph, groups, self.damping(grains, after, slow))
        groups[2] = groups[2] / state.radius[:, None].to(dtype)
        return torch.cat(groups[: self.integrator.n_groups], dim=1) * velocity_m_s / self.scale

    def _damped(
        self,
        state: State,
        free_vel: Float[Tensor, "n_grains 3"],
        graph: Graph,
        groups: list[Float[Tensor, "n_grains 3"]],
        shares: Float[Tensor, "n_grains 8"],
    ) -> list[Float[Tensor, "n_grains 3"]]:
        """What damping leaves of what contacts have changed, of grains that something reaches: back comes what damping
        takes from gravity in free flight, as far as others bear a grain; a share of its motion goes; and what they
        give is damped too."""
        free, dt_s, dtype = self.integrator.without_contact(state), self.scene.frame_dt_s, shares.dtype
        spin = torch.zeros_like(free_vel) if state.ang_vel is None else state.radius[:, None] * state.ang_vel
        start = torch.stack([state.vel, state.vel, spin])
        without = torch.stack([(state.vel + free_vel) / 2, free_vel, spin])  # undamped
        taken = without[:2] - torch.stack([(free.pos - state.pos) / dt_s, free.vel])
        start, without, taken = ((x / self.statistics.velocity_m_s).to(dtype) for x in (start, without, taken))
        damping, given = self.integrator.damping(state)[:, None].to(dtype), torch.stack(groups)
        drive = without - start if self.scene.damping_on_gravity else torch.zeros_like(start)
        added = cundall(start, drive + given, damping) - cundall(start, drive, damping)
        borne, slowed, felt = (
            shares[:, part].t()[:, :, None] for part in (Damping.BORNE, Damping.SLOWED, Damping.FELT)
        )
        left = given - slowed * (without + given) + felt * added
        left = torch.cat([left[:2] + borne * taken, left[2:]])
        touched = reached(len(state.pos), *graph.grain_edges, graph.wall_edges[1])
        return list(torch.where(touched[:, None], left, 0.0))

    def _grains(self, state: State, free_vel: Float[Tensor, "n_grains 3"]) -> Grains:
        """What grains carry into the first round: their speeds, and what they would do without contact."""
        dtype, velocity_m_s = self.scale.dtype, self.statistics.velocity_m_s
        ang_vel = torch.zeros_like(state.vel) if state.ang_vel is None else state.ang_vel
        speeds = ((state.vel, velocity_m_s), (ang_vel, self.statistics.spin_rad_s))
        columns = [torch.linalg.vector_norm(x, dim=1, keepdim=True) / scale for x, scale in speeds]
        latent = self.encode_grain(torch.cat(columns + self._kinds(state), dim=1).to(dtype))
        motion = state.vel.new_zeros(len(state.vel), 2, 3, self.config.channels)
        motion[:, 0, :, VELOCITY], motion[:, 0, :, GAINED] = free_vel, free_vel - state.vel
        motion[:, 1, :, VELOCITY] = state.radius[:, None] * ang_vel
        return Grains(latent, (motion / velocity_m_s).to(dtype))

    @property
    def settles(self) -> bool:
        """Whether a state that a step leaves as it was stays so: nothing drives it from outside."""
        return self.requires.rest and self.scene.inlet is None

    @property
    def pairs_once(self) -> bool:
        """Whether a graph holds one direction of a pair, from the grain of the lower number; else both."""
        return self.config.network == "impulse"

    @property
    def halo_m(self) -> float:
        """How far away a grain can be and still have a part in another's next step: a cutoff per round of message
        passing, and one for who can touch it, which a pair's own ends do not need."""
        ask = self.requires.free_grains and not self.requires.touching_pairs
        return (self.config.layers + ask) * self.cutoff_m * (1 + 1e-9)

    @property
    def cutoff_m(self) -> float:
        """Reach of grain-grain edges: of the largest grain."""
        return self.config.cutoff_grain_radii * max(self.scene.grains.radii_m)

    def in_reach(self, state: State, edges: Int[Tensor, "2 e"]) -> Bool[Tensor, " e"]:
        """Which pairs are within their own cutoff: that many times the mean of their radii."""
        sender, receiver = edges
        reach = self.config.cutoff_grain_radii * (state.radius[sender] + state.radius[receiver]) / 2
        return (state.pos[sender] - state.pos[receiver]).square().sum(1) <= reach.square()

    def pairs_in_reach(self, state: State) -> Int[Tensor, "2 e"]:
        """Every [sender, receiver] within its cutoff."""
        index = backend(self.config.neighbors, state.pos.device).build(state.pos, state.batch)
        search = index if self.config.self_loops else pairs(index)
        edges = search(state.pos, state.batch, self.cutoff_m)
        return edges if len(self.scene.grains.radii_m) == 1 else edges[:, self.in_reach(state, edges)]

    def graph(self, state: State) -> Graph:
        """Who can touch whom within the cutoffs. Not differentiable."""
        state = replace(state, pos=state.pos.detach(), vel=state.vel.detach())
        edges = self.pairs_in_reach(state)
        if self.pairs_once:
            edges = edges[:, edges[0] < edges[1]]
        graph = Graph(edges, edges.new_empty(2, 0))
        if self.boundary is not None:
            walls, contacts = self.boundary.contacts(state)
            graph = Graph(edges, contacts, walls)
        if self.requires.free_grains:
            near = self.near(state, graph)
            alone = self.requires.touching_pairs
            graph = meeting(graph, *near) if alone else among(graph, can_touch(graph, *near, len(state.pos)))
        return graph

    def near(self, state: State, graph: Graph) -> tuple[Bool[Tensor, " e"], Bool[Tensor, " w"]]:
        """Which edges' ends can meet within the frame (see `free_grains`)."""
        dt_s, margin_m = self.scene.frame_dt_s, MARGIN_RADII * state.radius
        if self.requires.touching_pairs:
            margin_m = pair_margin_m(state.radius, self.scene.gravity_m_s2, dt_s)
        return can_meet(state, self.integrator.without_contact(state).pos, graph, dt_s, margin_m)

    def _grain_features(self, state: State) -> Float[Tensor, "n_grains f"]:
        columns = [state.vel / self.statistics.velocity_m_s]
        if state.ang_vel is not None:
            columns.append(state.ang_vel / self.statistics.spin_rad_s)
        columns += self._kinds(state)
        if self.config.absolute_position:
            columns.append(self._absolute(state.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def _kinds(self, state: State) -> list[Float[Tensor, "n_grains _"]]:
        """What makes grains unlike each other: radius and material, where the scene requires it."""
        columns = []
        if self.requires.radius_features:
            columns.append(state.radius[:, None] / self.statistics.radius_m)
        if self._conditions and state.parameters is not None:
            mean, std = (
                constant(v, state.pos) for v in (self.statistics.parameters_mean, self.statistics.parameters_std)
            )
            columns.append(((state.parameters - mean) / std)[:, self._conditions][state.batch])
        return columns

    def _wall_features(self, walls: Walls) -> Float[Tensor, "n_points f"]:
        columns = [walls.normal]
        if self.requires.wall_velocity:
            columns.append(walls.vel / self.statistics.velocity_m_s)
        if self.requires.wall_friction:
            columns.append(walls.friction_angle[:, None])
        if self.config.absolute_position:
            columns.append(self._absolute(walls.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def check_place(self, state: State) -> None:
        """Raises ConfigError if the model sees absolute positions and the grains are far from where it learned them."""
        if self.config.absolute_position and len(state.pos):
            farthest = float(self._absolute(state.pos).abs().max())
            require(
                farthest <= FARTHEST,
                "model.absolute_position",
                f"true, and a grain {farthest:.3g} standard deviations from the training cases' mean position",
                f"at most {FARTHEST:g}: the model knows no other place",
                "simulate where it was trained, or train with model.absolute_position=false",
            )

    def _absolute(self, pos: Tensor) -> Tensor:
        return (pos - constant(self.statistics.position_mean_m, pos)) / self.statistics.position_std_m

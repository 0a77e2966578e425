"""State in, next state out: the only code that training, roll-out and evaluation share."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gns_pyg.dynamics.boundary import Boundary
from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.graph import features
from gns_pyg.graph.neighbors import backend, pairs
from gns_pyg.models.contact_network import ContactNetwork
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints
from gns_pyg.scene.scene import Scene
from gns_pyg.state import Graph, State, Walls


class Simulator(nn.Module):
    """Two contact networks, one for grain-grain and one for grain-boundary contact, and the integrator.

    A scene without a boundary has no boundary and no wall network.

    Args:
        scene: what is simulated; gives gravity, damping, frame step and the walls' motion.
        config: the model's choices.
        points: boundary points of each part, body frame.
        statistics: scales of the training data.
    """

    scale: Tensor

    def __init__(
        self, scene: Scene, config: ModelConfig, points: Mapping[str, BoundaryPoints], statistics: Statistics
    ) -> None:
        super().__init__()
        self.scene, self.config, self.statistics = scene, config, statistics
        self.integrator = Integrator(scene, config.state, residual=config.residual)
        scale = torch.tensor(statistics.correction).repeat_interleave(3)
        self.register_buffer("scale", scale, persistent=False)

        width: dict[str, Any] = dict(
            n_out=3 * self.integrator.n_groups,
            hidden=config.hidden,
            layers=config.layers,
            mlp_layers=config.mlp_layers,
            skip=config.skip,
        )
        n_position = 3 * config.absolute_position
        n_grain = 3 + 3 * (config.state == "full") + n_position
        n_edge = features.n_grain_edge_features(config.contact_features)
        self.grain_network = ContactNetwork(n_sender=None, n_receiver=n_grain, n_edge=n_edge, **width)
        self.boundary: Boundary | None = None
        self.wall_network: ContactNetwork | None = None
        if scene.boundary:
            self.boundary = Boundary(scene, points, config.neighbors)
            n_point = 3 + 3 * self.boundary.moves + n_position
            n_edge = features.n_wall_edge_features(config.contact_features)
            self.wall_network = ContactNetwork(n_sender=n_point, n_receiver=n_grain, n_edge=n_edge, **width)

    def forward(self, state: State) -> State:
        """Moves every grain by one frame."""
        return self.integrator.integrate(state, self.correction(state) * self.scale)

    def target(self, state: State, following: State) -> Float[Tensor, "n_grains d"]:
        """The value of `correction` that takes `state` to `following`; what training aims at."""
        return (self.integrator.target(state, following) / self.scale).to(self.scale.dtype)

    def correction(self, state: State) -> Float[Tensor, "n_grains d"]:
        """What contacts add, over `scale`: the sum of both networks (the paper's equation (10))."""
        graph = self.graph(state)
        grains = self._grain_features(state)
        options: dict[str, Any] = dict(
            velocity_m_s=self.statistics.velocity_m_s,
            dt_s=self.scene.frame_dt_s,
            contact=self.config.contact_features,
        )
        edges = features.grain_edges(state, graph, **options).to(self.scale.dtype)
        total = self.grain_network(None, grains, edges, graph.grain_edges)
        if self.boundary is not None and self.wall_network is not None:
            walls = self.boundary.at(state.time_s)
            edges = features.wall_edges(state, walls, graph, **options).to(self.scale.dtype)
            total = total + self.wall_network(self._wall_features(walls), grains, edges, graph.wall_edges)
        return total

    def graph(self, state: State) -> Graph:
        """Who can touch whom within the cutoffs. Not differentiable."""
        return Graph(self._grain_edges(state), self._wall_edges(state))

    def _grain_edges(self, state: State) -> Int[Tensor, "2 e"]:
        pos, reach_m = state.pos.detach(), self.config.cutoff_grain_radii * self.scene.grains.radius_m
        index = backend(self.config.neighbors, pos.device).build(pos, state.batch)
        search = index if self.config.self_loops else pairs(index)
        return search(pos, state.batch, reach_m)

    def _wall_edges(self, state: State) -> Int[Tensor, "2 e"]:
        if self.boundary is None:
            return state.batch.new_empty(2, 0)
        return self.boundary.edges(state, self.config.cutoff_wall_radii * self.scene.grains.radius_m)

    def _grain_features(self, state: State) -> Float[Tensor, "n_grains f"]:
        columns = [state.vel / self.statistics.velocity_m_s]
        if state.ang_vel is not None:
            columns.append(state.ang_vel / self.statistics.spin_rad_s)
        if self.config.absolute_position:
            columns.append(self._absolute(state.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def _wall_features(self, walls: Walls) -> Float[Tensor, "n_points f"]:
        columns = [walls.normal]
        if self.boundary is not None and self.boundary.moves:
            columns.append(walls.vel / self.statistics.velocity_m_s)
        if self.config.absolute_position:
            columns.append(self._absolute(walls.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def _absolute(self, pos: Tensor) -> Tensor:
        return (pos - pos.new_tensor(self.statistics.position_mean_m)) / self.statistics.position_std_m

"""State in, next state out: the only code that training, roll-out and evaluation share."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gns_pyg.dynamics.integrator import Integrator
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.graph import features
from gns_pyg.graph.neighbors import backend, pairs
from gns_pyg.models.contact_network import ContactNetwork
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints
from gns_pyg.scene.motion import rotation, to_body, to_world
from gns_pyg.scene.scene import Scene
from gns_pyg.state import Graph, State, Walls


class Simulator(nn.Module):
    """Two contact networks, one for grain-grain and one for grain-boundary contact, and the integrator.

    Args:
        scene: what is simulated; gives gravity, damping, frame step and the walls' motion.
        config: the model's choices.
        boundary: boundary points of each part, body frame.
        statistics: scales of the training data.
    """

    def __init__(
        self, scene: Scene, config: ModelConfig, boundary: Mapping[str, BoundaryPoints], statistics: Statistics
    ) -> None:
        super().__init__()
        self.scene, self.config, self.statistics = scene, config, statistics
        self.integrator = Integrator(scene, config.state, residual=config.residual)
        self.walls_move = any(part.motion.moves for part in scene.boundary.values())
        for name in scene.boundary:
            self.register_buffer(f"wall_pos_{name}", torch.as_tensor(boundary[name].pos, dtype=torch.float64))
            self.register_buffer(f"wall_normal_{name}", torch.as_tensor(boundary[name].normal, dtype=torch.float64))
        scales = np.repeat(statistics.correction, 3)
        self.register_buffer("scale", torch.as_tensor(scales, dtype=torch.float32), persistent=False)
        self._indices: dict[str, tuple[torch.device, object]] = {}

        shared = {
            "n_out": 3 * self.integrator.n_groups,
            "hidden": config.hidden,
            "layers": config.layers,
            "mlp_layers": config.mlp_layers,
            "skip": config.skip,
        }
        n_position = 3 * config.absolute_position
        n_grain = 3 + 3 * (config.state == "full") + n_position
        n_edge = features.n_grain_edge_features(config.contact_features)
        self.grain_network = ContactNetwork(n_sender=None, n_receiver=n_grain, n_edge=n_edge, **shared)
        self.wall_network = None
        if scene.boundary:
            n_wall, n_edge = 3 + 3 * self.walls_move, features.n_wall_edge_features(config.contact_features)
            self.wall_network = ContactNetwork(
                n_sender=n_wall + n_position, n_receiver=n_grain, n_edge=n_edge, **shared
            )

    def forward(self, state: State) -> State:
        """Moves every grain by one frame."""
        return self.integrator.integrate(state, self.correction(state) * self.scale)

    def correction(self, state: State) -> Float[Tensor, "n_grains d"]:
        """What contacts add, over `scale`: the sum of both networks (the paper's equation (10))."""
        walls = self.walls(state)
        graph = self.graph(state)
        grain_features = self._grain_features(state)
        options = {
            "velocity_m_s": self.statistics.velocity_m_s,
            "dt_s": self.scene.frame_dt_s,
            "contact": self.config.contact_features,
        }
        edge_features = features.grain_edges(state, graph, **options).to(self.scale.dtype)
        total = self.grain_network(None, grain_features, edge_features, graph.grain_edges)
        if self.wall_network is not None:
            edge_features = features.wall_edges(state, walls, graph, **options).to(self.scale.dtype)
            total = total + self.wall_network(
                self._wall_features(walls), grain_features, edge_features, graph.wall_edges
            )
        return total

    def target(self, state: State, following: State) -> Float[Tensor, "n_grains d"]:
        """The value of `correction` that takes `state` to `following`; what training aims at."""
        return (self.integrator.target(state, following) / self.scale).to(self.scale.dtype)

    def walls(self, state: State) -> Walls:
        """Boundary points of every graph at its time."""
        pos, normal, vel = [], [], []
        for name, part in self.scene.boundary.items():
            part_pos, part_vel = to_world(part.motion, self.get_buffer(f"wall_pos_{name}"), state.time_s)
            turned = rotation(part.motion, state.time_s).transpose(1, 2)
            pos.append(part_pos)
            normal.append(self.get_buffer(f"wall_normal_{name}") @ turned)
            vel.append(part_vel)
        if not pos:
            none = state.pos.new_zeros(0, 3)
            return Walls(none, none, none)
        return Walls(*(torch.cat(parts, dim=1).flatten(0, 1) for parts in (pos, normal, vel)))

    def graph(self, state: State) -> Graph:
        """Who can touch whom. Walls are searched in their body frame, where they never move: built once."""
        search = backend(self.config.neighbors, state.pos.device)
        radius_m = self.scene.grains.radius_m
        index = search.build(state.pos, state.batch)
        reach = self.config.cutoff_grain_radii * radius_m
        grain_edges = (
            index(state.pos, state.batch, reach)
            if self.config.self_loops
            else pairs(index, state.pos, state.batch, reach)
        )
        found, offset, one_graph = [], 0, torch.zeros_like(state.batch)
        n_points = sum(len(self.get_buffer(f"wall_pos_{name}")) for name in self.scene.boundary)
        for name, part in self.scene.boundary.items():
            body_pos = to_body(part.motion, state.pos, state.time_s[state.batch])
            point, grain = self._wall_index(name, search)(body_pos, one_graph, self.config.cutoff_wall_radii * radius_m)
            found.append(torch.stack([point + offset + n_points * state.batch[grain], grain]))
            offset += len(self.get_buffer(f"wall_pos_{name}"))
        wall_edges = torch.cat(found, dim=1) if found else grain_edges.new_empty(2, 0)
        return Graph(grain_edges, wall_edges)

    def _wall_index(self, name: str, search):
        points = self.get_buffer(f"wall_pos_{name}")
        if self._indices.get(name, (None,))[0] != points.device:
            batch = torch.zeros(len(points), dtype=torch.long, device=points.device)
            self._indices[name] = (points.device, search.build(points, batch))
        return self._indices[name][1]

    def _grain_features(self, state: State) -> Tensor:
        columns = [state.vel / self.statistics.velocity_m_s]
        if state.ang_vel is not None:
            columns.append(state.ang_vel / self.statistics.spin_rad_s)
        if self.config.absolute_position:
            columns.append(self._absolute(state.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def _wall_features(self, walls: Walls) -> Tensor:
        columns = [walls.normal]
        if self.walls_move:
            columns.append(walls.vel / self.statistics.velocity_m_s)
        if self.config.absolute_position:
            columns.append(self._absolute(walls.pos))
        return torch.cat(columns, dim=1).to(self.scale.dtype)

    def _absolute(self, pos: Tensor) -> Tensor:
        return (pos - pos.new_tensor(self.statistics.position_mean_m)) / self.statistics.position_std_m

"""Small untrained simulators and random states for the tests."""

from typing import Any

import numpy as np
import torch

from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import sample_boundary_points
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.requirements import Requires, resolve
from gns_pyg.scene.scene import Scene
from gns_pyg.state import State

MODEL: dict[str, Any] = {
    "absolute_position": False,
    "contact_features": True,
    "self_loops": False,
    "skip": True,
    "hidden": 16,
    "layers": 2,
    "mlp_layers": 2,
    "cutoff_grain_radii": 3.0,
    "cutoff_wall_radii": 3.0,
}
PAPER = {
    "state": "differences",
    "free_flight": False,
    "free_grains": False,
    "absolute_position": True,
    "contact_features": False,
    "self_loops": True,
    "skip": False,
}
IMPULSE = {"network": "impulse"}
TOUCHING = IMPULSE | {"touching_pairs": True}
STATISTICS = dict(
    velocity_m_s=0.5,
    spin_rad_s=20.0,
    radius_m=0.01,
    position_mean_m=[0.0, 0.0, 0.1],
    position_std_m=0.1,
    parameters_mean=[1000.0, 1e6, 0.25, 0.5, 0.1],
    parameters_std=[1.0, 1.0, 1.0, 0.2, 1.0],
)


def simulator(
    scene: Scene, seed: int = 0, dtype: torch.dtype = torch.float32, varying: Any = None, **changes: Any
) -> Simulator:
    """An untrained simulator of `scene`; `changes` replace keys of MODEL or force rows of what the scene requires.

    In float64 every weight is float64. `varying` holds the parameters' values over the cases.
    """
    forced = {row: changes.pop(row) for row in list(changes) if row in Requires.__dataclass_fields__}
    config = ModelConfig(**(MODEL | changes))
    requires = resolve(scene, varying or {}, Requires(**forced))
    groups = 1 + ("differences", "velocity", "full").index(requires.state)
    statistics = Statistics(**STATISTICS, correction=[0.1, 0.2, 10.0][:groups])
    points = {
        name: sample_boundary_points(build_mesh(name, part), part.points) for name, part in scene.boundary.items()
    }
    torch.manual_seed(seed)
    return Simulator(scene, config, requires, points, statistics).to(dtype).eval()


def state_in_box(n_per_graph: list[int], seed: int = 0, half_m: float = 0.06, spin: bool = True) -> State:
    """Random grains of 1 cm radius in a cube around the origin, one cube per graph; overlaps are allowed."""
    n, random = sum(n_per_graph), np.random.default_rng(seed)
    return State(
        pos=torch.from_numpy(random.uniform(-half_m, half_m, (n, 3))),
        vel=torch.from_numpy(random.normal(0, 0.5, (n, 3))),
        ang_vel=torch.from_numpy(random.normal(0, 20, (n, 3))) if spin else None,
        radius=torch.full((n,), 0.01, dtype=torch.float64),
        time_s=torch.linspace(0.1, 0.4, len(n_per_graph), dtype=torch.float64),
        batch=torch.repeat_interleave(torch.arange(len(n_per_graph)), torch.tensor(n_per_graph)),
    )

"""What the fuzz run draws: simulators of every kind of scene, and states that nobody would prepare on purpose."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor
from trimesh import Trimesh

from gns_pyg import bundle
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints, sample_boundary_points
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.requirements import Requires, resolve
from gns_pyg.scene.scene import Motion, Scene
from gns_pyg.state import State
from tests.scenes import scene
from tests.simulators import IMPULSE, MODEL, PAPER

SIZES = {"one": (1.0,), "two": (0.4, 1.0), "far apart": (0.01, 1.0)}
MODELS: dict[str, dict[str, Any]] = {
    "full": {},
    "velocity": {"state": "velocity", "contact_features": False},
    "differences": {"state": "differences", "skip": False},
    "paper": PAPER,
    "impulse": IMPULSE,
    "impulse, differences": IMPULSE | {"state": "differences"},
}
MATERIAL = vars(scene(1, 5).grains.material)
PLACES = ("loose", "crowded", "coincident", "near", "far", "on a point", "on an edge", "behind a wall")
FARTHEST_M = 1e6
FASTEST_M_S = 100.0


@dataclass(frozen=True)
class Setup:
    """A scene of one size of grains, and the model of it; see the constants above."""

    walls: str = "none"
    radius_m: float = 0.01
    sizes: str = "one"
    model: str = "full"
    dtype: torch.dtype = torch.float32
    outlet: bool = False
    varying: bool = False
    center_m: float = 0.0
    damping: float = 0.0
    neighbors: str = "auto"
    projection_sweeps: int = 0


CHOICES: dict[str, Any] = {
    "walls": ("none", "floor", "box", "drum", "slivers"),
    "radius_m": (1e-5, 1e-3, 1e-2, 1.0),
    "sizes": tuple(SIZES),
    "model": tuple(MODELS),
    "dtype": (torch.float32, torch.float64),
    "outlet": (False, True),
    "varying": (False, True),
    "center_m": (0.0, 1.0, 1e6),
    "damping": (0.0, 0.2, 0.9),
    "neighbors": ("auto", "grid"),
    "projection_sweeps": (0, 3),
}


def _setups(n: int) -> list[Setup]:
    random = np.random.default_rng(0)
    return [Setup(**{key: values[random.integers(len(values))] for key, values in CHOICES.items()}) for _ in range(n)]


SETUPS = _setups(500)  # every two choices meet, and nearly every three; each simulator is built once
BUNDLES = ("hopper", "drum", "inclined_drum")


@dataclass(frozen=True)
class Subject:
    """A simulator, and where its scene is.

    Attributes:
        edges: ends of the mesh edges of every boundary part, in its body frame, m, (n, 2, 3).
        center_m: all three coordinates of the middle.
    """

    name: str
    simulator: Simulator = field(repr=False)
    edges: dict[str, np.ndarray] = field(repr=False)
    center_m: float = 0.0


def _world(setup: Setup) -> tuple[Scene, dict[str, BoundaryPoints], dict[str, np.ndarray]]:
    """The scene, about 20 radii wide, its frame as long as the fall through a twentieth of a radius; its boundary
    points and mesh edges."""
    radius, center = setup.radius_m, [setup.center_m] * 3
    shapes: dict[str, dict[str, Any]] = {
        "floor": {"kind": "floor", "size_m": [20 * radius, 20 * radius], "center_m": center},
        "box": {"kind": "box", "size_m": [15 * radius] * 3, "center_m": center},
        "drum": {"kind": "cylinder", "radius_m": 8 * radius, "length_m": 6 * radius, "axis": [1.0, 0.0, 0.0]},
        "slivers": {"kind": "floor", "size_m": [20 * radius, 1e-3 * radius], "center_m": center},
    }
    part: dict[str, Any] = {"shape": shapes.get(setup.walls), "points": 150, "friction_angle_rad": 0.5}
    dt_s = float(np.sqrt(radius / 98.1))
    if setup.walls == "drum":
        part["motion"] = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": 0.03 / dt_s}
    changes: dict[str, Any] = {}
    if setup.outlet:
        below = [setup.center_m, setup.center_m, setup.center_m - 3 * radius]
        changes["outlet"] = {"point_m": below, "normal": [0.0, 0.0, -1.0]}
    radii = [size * radius for size in SIZES[setup.sizes]]
    made = scene(
        10,
        5,
        dt_s,
        damping=setup.damping,
        boundary={} if setup.walls == "none" else {"walls": part},
        grains={"count": 10, "radius_m": radii, "material": MATERIAL},
        **changes,
    )
    meshes = {name: build_mesh(name, part) for name, part in made.boundary.items()}
    points = {name: sample_boundary_points(mesh, 150) for name, mesh in meshes.items()}
    return made, points, {name: _edges(mesh) for name, mesh in meshes.items()}


def _edges(mesh: Trimesh) -> np.ndarray:
    return np.array(mesh.vertices)[mesh.edges_unique]


@cache
def untrained(setup: Setup) -> Subject:
    """A small model with statistics of the scene's size."""
    choices = MODEL | {"hidden": 8} | MODELS[setup.model]
    forced = {row: choices.pop(row) for row in list(choices) if row in Requires.__dataclass_fields__}
    made, points, edges = _world(setup)
    speed = float(np.sqrt(9.81 * setup.radius_m))
    varying = {"friction_angle_rad": [0.3, 0.5]} if setup.varying else {}
    requires = resolve(made, varying, Requires(**forced))
    groups = 1 + ("differences", "velocity", "full").index(requires.state)
    statistics = Statistics(
        velocity_m_s=speed,
        spin_rad_s=speed / setup.radius_m,
        radius_m=setup.radius_m,
        correction=[speed, speed, speed / setup.radius_m][:groups],
        position_mean_m=[setup.center_m] * 3,
        position_std_m=5 * setup.radius_m,
        parameters_mean=[1000.0, 1e6, 0.25, 0.4, 0.1],
        parameters_std=[1.0, 1.0, 1.0, 0.1, 1.0],
    )
    config = ModelConfig(**choices, neighbors=setup.neighbors, projection_sweeps=setup.projection_sweeps)
    torch.manual_seed(0)
    simulator = Simulator(made, config, requires, points, statistics).to(setup.dtype).eval()
    return Subject(str(setup), simulator, edges, setup.center_m)


@cache
def shipped(name: str) -> Subject:
    """A bundle that ships with the project, in its own scene."""
    simulator = bundle.load(name)
    edges = {name: _edges(build_mesh(name, part)) for name, part in simulator.scene.boundary.items()}
    return Subject(name, simulator, edges)


@st.composite
def states(draw: st.DrawFn, subject: Subject) -> State:
    """One to three graphs of 0 to 40 grains, in groups of one kind of place and one speed."""
    graphs = draw(st.lists(st.lists(_groups, max_size=4), min_size=1, max_size=3))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    times = draw(st.lists(st.sampled_from([0.0, 0.37, 1e4]), min_size=len(graphs), max_size=len(graphs)))
    simulator = subject.simulator
    radii = np.array(simulator.scene.grains.radii_m)
    pos, vel, spin, batch = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, int)]
    for graph, (groups, time_s) in enumerate(zip(graphs, times, strict=True)):
        placed = _Places(subject, time_s, random)
        for place, n, speed, turning in groups:
            pos.append(placed.of(place, n))
            vel.append(speed * random.normal(0, 1, (n, 3)).clip(-1, 1))
            spin.append(turning * random.normal(0, 1, (n, 3)) / radii[-1])
            batch.append(np.full(n, graph))
    where = torch.from_numpy(np.concatenate(pos))
    parameters = [list(simulator.scene.parameters.values())] * len(graphs)
    told = bool(simulator.requires.material_features) or draw(st.booleans())
    return State(
        pos=where,
        vel=torch.from_numpy(np.concatenate(vel)),
        ang_vel=torch.from_numpy(np.concatenate(spin)) if simulator.requires.state == "full" else None,
        radius=torch.from_numpy(random.choice(radii, len(where))),
        time_s=torch.tensor(times, dtype=torch.float64),
        batch=torch.from_numpy(np.concatenate(batch)),
        parameters=torch.tensor(parameters, dtype=torch.float64) if told else None,
        active=torch.from_numpy(random.random(len(where)) < 0.8) if simulator.requires.active_mask else None,
    )


_speeds = st.sampled_from([0.0, 1e-30, 0.1, 3.0, FASTEST_M_S])
_groups = st.tuples(st.sampled_from(PLACES), st.integers(0, 10), _speeds, _speeds)


class _Places:
    """Draws the places of one graph's grains; some lie where the one before lies."""

    def __init__(self, subject: Subject, time_s: float, random: np.random.Generator) -> None:
        simulator = subject.simulator
        self.radius, self.random = max(simulator.scene.grains.radii_m), random
        self.center = self.last = np.full(3, subject.center_m)
        parts = list(simulator.boundary or ())
        at = [part.at(torch.arange(len(part.pos)), _times(len(part.pos), time_s)) for part in parts]
        self.points, self.normals, self.edges = None, None, None
        if at:
            self.points, self.normals = (
                np.concatenate([getattr(walls, key).numpy() for walls in at]) for key in ("pos", "normal")
            )
            placed = [
                _placed(part.motion, subject.edges[name], time_s) for name, part in simulator.scene.boundary.items()
            ]
            self.edges = np.concatenate(placed)

    def of(self, place: str, n: int) -> np.ndarray:
        """(n, 3), m."""
        random, radius = self.random, self.radius
        walled = self.points is not None
        if place == "loose" or (place in PLACES[5:] and not walled):
            found = self.center + random.uniform(-6, 6, (n, 3)) * radius
        elif place == "crowded":
            found = self.last + random.uniform(-1, 1, (n, 3)) * radius
        elif place == "coincident":
            found = np.repeat(self.last[None], n, 0)
        elif place == "near":  # down to a distance whose square, then itself, is 0 in float32
            found = self.last + self._directions(n) * 2 * radius * 10.0 ** random.uniform(-60, 0, (n, 1))
        elif place == "far":
            least = np.log10(10 * radius)
            away = 10.0 ** random.uniform(least, np.log10(FARTHEST_M), (n, 1))
            found = self.center + self._directions(n) * away
        elif place == "on an edge":
            start, end = self.edges[random.integers(len(self.edges), size=n)].transpose(1, 0, 2)
            found = start + (end - start) * random.choice([0.0, 0.5, random.random()], (n, 1))
        else:
            row = random.integers(len(self.points), size=n)
            depth = 0.0 if place == "on a point" else random.uniform(-1, 1, (n, 1)) * radius
            found = self.points[row] - depth * self.normals[row]
        self.last = found[-1] if n else self.last
        return found

    def _directions(self, n: int) -> np.ndarray:
        drawn = self.random.normal(0, 1, (n, 3))
        return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def _times(n: int, time_s: float) -> Tensor:
    return torch.full((n,), time_s, dtype=torch.float64)


def _placed(motion: Motion, edges: np.ndarray, time_s: float) -> np.ndarray:
    """Mesh edges in the world, m, (n, 2, 3)."""
    ends = torch.from_numpy(edges.reshape(-1, 3))
    return to_world(motion, ends, _times(len(ends), time_s))[0].numpy().reshape(-1, 2, 3)

"""The same simulator in another scene, at another place, in other units: what its equations say must not change.

Walls are carried along as they are: the same triangles and boundary points, moved and scaled.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from trimesh.exchange.obj import export_obj

from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints, boundary_points
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.requirements import transferred
from gns_pyg.scene.scene import Part, Scene
from gns_pyg.state import State


def in_scene(
    simulator: Simulator,
    scene: Scene,
    points: Mapping[str, BoundaryPoints] | None = None,
    statistics: Statistics | None = None,
) -> Simulator:
    """The same networks in another scene.

    Args:
        simulator: whose networks.
        scene: the other scene.
        points: its boundary points, if they are known.
        statistics: scales, if they are others.

    Raises:
        ConfigError: if the model lacks what the scene needs.
    """
    requires = transferred(simulator.requires, simulator.scene, scene)
    points = boundary_points(scene, simulator.config.cutoff_wall_radii) if points is None else points
    other = Simulator(scene, simulator.config, requires, points, statistics or simulator.statistics)
    weights = {key: value for key, value in simulator.state_dict().items() if not key.startswith("boundary.")}
    other.load_state_dict(weights, strict=False)
    return other.to(simulator.scale.dtype).to(simulator.scale.device).eval()


@contextmanager
def elsewhere(
    simulator: Simulator, state: State, shift_m: float = 0.0, length: float = 1.0, time: float = 1.0
) -> Iterator[tuple[Simulator, State]]:
    """Yields simulator and state moved by `shift_m` along every axis, all lengths `length` and all times `time` times
    as large; gravity and the training data's scales go with them.

    The walls' meshes lie in a folder that is gone afterwards. Motions that are functions of time cannot change units.
    """
    scene, speed = deepcopy(simulator.scene), length / time
    with TemporaryDirectory() as folder:
        points = {}
        parts = list(simulator.boundary or ())
        for (name, part), held in zip(scene.boundary.items(), parts, strict=True):
            scene.boundary[name] = _moved_part(name, part, Path(folder), shift_m, length, time)
            pos, normal = held.pos.cpu().numpy(), held.normal.cpu().numpy()
            points[name] = BoundaryPoints(pos * length + shift_m, normal)
        radii = [length * radius for radius in scene.grains.radii_m]
        scene.grains.radius_m = radii if len(radii) > 1 else radii[0]
        scene.frame_dt_s, scene.duration_s = scene.frame_dt_s * time, scene.duration_s * time
        scene.gravity_m_s2 = [g * speed / time for g in scene.gravity_m_s2]
        old = simulator.statistics
        per_group = [speed, speed, 1 / time]
        scales = replace(
            old,
            velocity_m_s=old.velocity_m_s * speed,
            spin_rad_s=old.spin_rad_s / time,
            radius_m=old.radius_m * length,
            correction=[scale * by for scale, by in zip(old.correction, per_group, strict=False)],
        )
        moved = replace(
            state,
            pos=state.pos * length + shift_m,
            vel=state.vel * speed,
            ang_vel=None if state.ang_vel is None else state.ang_vel / time,
            drift=None if state.drift is None else state.drift * speed,
            radius=state.radius * length,
            time_s=state.time_s * time,
        )
        yield in_scene(simulator, scene, points, scales), moved


def _moved_part(name: str, part: Part, folder: Path, shift_m: float, length: float, time: float) -> Part:
    mesh = build_mesh(name, part)
    mesh.vertices = np.asarray(mesh.vertices) * length + shift_m
    path = folder / f"{name}.obj"
    path.write_text(export_obj(mesh, include_normals=False, digits=17))
    old = part.motion
    motion = replace(
        old,
        origin_m=[length * x + shift_m for x in old.origin_m],
        rate_rad_s=old.rate_rad_s / time,
        speed_m_s=old.speed_m_s * length / time,
        amplitude_m=old.amplitude_m * length,
        frequency_hz=old.frequency_hz / time,
    )
    return replace(part, shape={"kind": "file", "path": str(path)}, motion=motion)

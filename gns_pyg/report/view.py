"""How a scene is looked at, in pictures and in the player alike."""

import numpy as np
import torch
from trimesh import Trimesh

from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import Motion, Scene
from gns_pyg.scene.symmetry import up_direction

COLOUR_QUANTILE = 0.99  # a colour scale ends here, so that one fast grain does not darken all others


def view(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors to the right, up (against gravity) and towards the reader."""
    up = up_direction(scene)
    definition = scene.angle_of_repose
    wanted = [np.asarray(definition.axis, float)] if definition is not None and definition.kind == "plane" else []
    for motion in (part.motion for part in scene.boundary.values() if part.motion.moves):
        axis = np.asarray(motion.axis, float)
        wanted.append(axis if motion.kind == "rotation" else np.cross(up, axis))
    wanted += [np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])]
    across = (axis - (axis @ up) * up for axis in wanted)
    depth = next(axis / np.linalg.norm(axis) for axis in across if np.linalg.norm(axis) > 1e-6)
    return np.cross(up, depth), up, depth


def placed(mesh: Trimesh, motion: Motion, time_s: float) -> np.ndarray:
    """Vertices of a part at `time_s`, (n, 3), m."""
    vertices = torch.tensor(np.array(mesh.vertices))
    return to_world(motion, vertices, torch.full((len(vertices),), time_s, dtype=torch.float64))[0].numpy()

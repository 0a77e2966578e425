"""What a set of cases covers, and what of a new one lies outside."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.data.windows import parameters
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.motion import to_world
from gns_pyg.scene.scene import PARAMETERS, Scene

SPEEDS = ("grain speed, m/s", "angular speed, rad/s")  # an upper limit counts, with some room
WALLS = "wall speed, m/s"  # of each part's fastest corner; both limits count, with some room
ROOM, SLACK = 1.2, 0.01
SAME_START = 1e-3  # of a radius: starts nearer than this are of one run, recorded otherwise


def values(trajectories: Sequence[Trajectory]) -> dict[str, list[float]]:
    """Every parameter of `scene.PARAMETERS` -> its values in the cases."""
    columns = np.array([parameters(trajectory) for trajectory in trajectories]).T
    return {name: sorted(set(column.tolist())) for name, column in zip(PARAMETERS, columns, strict=True)}


def coverage(scene: Scene, trajectories: Sequence[Trajectory], frames: slice = slice(None)) -> dict[str, list[float]]:
    """[lowest, highest] of everything that a model trained on the cases has seen.

    Args:
        scene: what they are cases of.
        trajectories: the cases.
        frames: frames whose speeds count.
    """
    ranges = {name: [found[0], found[-1]] for name, found in values(trajectories).items()}
    if walls := [part.friction_angle_rad for part in scene.boundary.values()]:
        ranges["wall friction angle, rad"] = [min(walls), max(walls)]
    ranges["grain radius, m"] = [scene.grains.radii_m[0], scene.grains.radii_m[-1]]
    strength = float(np.linalg.norm(scene.gravity_m_s2))
    ranges["gravity, m/s^2"] = [strength] * 2
    tilt = np.degrees(np.arccos(np.clip(-scene.gravity_m_s2[2] / strength, -1, 1))) if strength else 0.0
    ranges["angle of gravity to -z, degrees"] = [float(tilt)] * 2
    ranges["frame, s"] = [scene.frame_dt_s] * 2
    for name, field in zip(SPEEDS, ("velocity", "angular_velocity"), strict=False):
        fastest = [np.linalg.norm(t.read(field, frames.start or 0, frames.stop), axis=2).max() for t in trajectories]
        ranges[name] = [0.0, float(max(fastest))]
    fastest_walls = _wall_speeds(scene) or [0.0]
    ranges[WALLS] = [min(fastest_walls), max(fastest_walls)]
    return ranges


def outside_coverage(trained: Mapping[str, Sequence[float]], now: Mapping[str, Sequence[float]]) -> list[str]:
    """One sentence for every range of `now` that leaves that of `trained`."""
    texts = []
    for name, (low, high) in now.items():
        if name not in trained:
            texts.append(f"{name}: {high:.4g}; the model has seen none")
            continue
        lowest, highest = trained[name]
        slack = SLACK * max(abs(lowest), abs(highest)) + 1e-9
        too_high = high > (ROOM * highest + 1e-9 if name in (*SPEEDS, WALLS) else highest + slack)
        too_low = name not in SPEEDS and low < (lowest / ROOM - 1e-9 if name == WALLS else lowest - slack)
        if too_high or too_low:
            shown = f"{high:.4g}" if too_high else f"{low:.4g}"
            seen = f"{highest:.4g}" if lowest == highest else f"{lowest:.4g} to {highest:.4g}"
            texts.append(f"{name}: {shown}; the model has seen {seen}")
    return texts


def _wall_speeds(scene: Scene) -> list[float]:
    """Every part's highest speed of a corner at the scene's frames, m/s."""
    times = scene.frame_dt_s * torch.arange(scene.n_frames, dtype=torch.float64)
    speeds = []
    for name, part in scene.boundary.items():
        fastest = 0.0
        if part.motion.moves:
            corners = torch.from_numpy(np.array(build_mesh(name, part).vertices))
            for time_s in times:
                vel = to_world(part.motion, corners, time_s.expand(len(corners)))[1]
                fastest = max(fastest, float(torch.linalg.vector_norm(vel, dim=1).max()))
        speeds.append(fastest)
    return speeds


def seen(case: Trajectory, scene: Scene, card: Mapping[str, Any]) -> bool:
    """Whether a bundle of this card was trained or validated on a case: on its content or, however it was recorded, on
    a case of the same start."""
    digests = {digest for purpose in ("train", "val") for digest in card["cases"][purpose].values()}
    return case.content_hash() in digests or _among(case.start(), card.get("starts", []), scene)


def starts(cases: Sequence[Trajectory], scene: Scene, earlier: Sequence[Any]) -> list[Any]:
    """The starts of the cases that a bundle is trained and validated on, and, each once, the `earlier` ones of the
    bundle whose weights that training went on from: weights do not forget."""
    own = [case.start() for case in cases]
    return own + [start for start in earlier if not _among(np.array(start), own, scene)]


def _among(start: np.ndarray, others: Sequence[Any], scene: Scene) -> bool:
    within_m = SAME_START * scene.grains.radii_m[0]
    arrays = (np.array(other) for other in others)
    return any(start.shape == other.shape and np.abs(start - other).max() < within_m for other in arrays)

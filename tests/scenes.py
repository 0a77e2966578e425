"""Small analytic scenes, written as real trajectory files: the tests know every answer.

Each `*_case` writes one case to `path` and returns its Scene. Lengths in m, times in s.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gns_pyg.config import plain
from gns_pyg.data.trajectory import TrajectoryWriter
from gns_pyg.scene.inlet import entries
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene

RADIUS_M = 0.01
DECIMALS = {"position": 9, "velocity": 9, "angular_velocity": 6}
BOX = {"kind": "box", "size_m": [4.0, 4.0, 4.0], "center_m": [0.0, 0.0, 0.0]}


def scene(n_grains: int, n_frames: int, frame_dt_s: float = 0.01, **changes: Any) -> Scene:
    """A still box of 4 m around the origin with glass-like grains; `changes` replace top-level keys of the scene."""
    values: dict[str, Any] = {
        "name": "analytic",
        "duration_s": (n_frames - 1) * frame_dt_s,
        "frame_dt_s": frame_dt_s,
        "cases": 1,
        "gravity_m_s2": [0.0, 0.0, -9.81],
        "damping": 0.0,
        "grains": {
            "count": n_grains,
            "radius_m": RADIUS_M,
            "material": {
                "density_kg_m3": 1000.0,
                "young_modulus_pa": 1e6,
                "poisson_ratio": 0.25,
                "friction_angle_rad": 0.5,
            },
        },
        "initial": {"arrangement": "random", "speed_max_m_s": 0.5},
        "boundary": {"walls": {"shape": BOX, "points": 200, "friction_angle_rad": 0.5}},
    }
    return Scene.from_config(values | changes)


def write_case(
    path: Path,
    scene: Scene,
    pos: np.ndarray,
    vel: np.ndarray | None = None,
    ang_vel: np.ndarray | None = None,
    active: np.ndarray | None = None,
) -> None:
    """Writes positions (n_frames, n_grains, 3) and velocities (0 where None) as a valid case of `scene`.

    The run facts are made up: one core, 1e-4 s steps, 12 s of wall clock.
    """
    n_frames = len(pos)
    vel, ang_vel = (np.zeros_like(pos) if values is None else values for values in (vel, ang_vel))
    boundary: dict[str, Mapping[str, Any]] = {}
    for name, part in scene.boundary.items():
        mesh = build_mesh(name, part)
        boundary[name] = {"vertices": mesh.vertices, "triangles": mesh.faces, "motion": plain(part.motion)}
    radius = np.repeat(*zip(*scene.grains.counts, strict=True))
    mass = scene.grains.material.density_kg_m3 * 4 / 3 * np.pi * radius**3
    steps = round(scene.frame_dt_s / 1e-4)
    with TrajectoryWriter(path, plain(scene), radius, mass, boundary, DECIMALS, active is not None) as writer:
        for frame in range(n_frames):
            there = None if active is None else active[frame]
            writer.append(frame * steps, frame * scene.frame_dt_s, pos[frame], vel[frame], ang_vel[frame], there)
        run = {"wall_clock_s": 12.0, "cores": 1, "steps": (n_frames - 1) * steps, "dt_s": 1e-4}
        writer.finish(run | {"creator": "tests", "creator_version": "1", "case": 0, "seed": scene.seed})


def free_flight_case(
    path: Path, n_grains: int = 20, n_frames: int = 21, damping: float = 0.0, rising: bool = True, seed: int = 0
) -> Scene:
    """Grains that touch nothing, from random places and velocities: the closed form of damped free flight.

    Args:
        damping: Cundall's damping, which acts on gravity here: g (1 + damping) on the way up, g (1 - damping) down.
        rising: whether grains may start upwards; without, no grain passes a turning point.
    """
    flight = scene(n_grains, n_frames, damping=damping)
    rng = np.random.default_rng(seed)
    start = rng.uniform(-0.5, 0.5, (n_grains, 3))
    speed = rng.uniform(-1.0, 1.0, (n_grains, 3))
    if not rising:
        speed[:, 2] = -np.abs(speed[:, 2])
    time = flight.frame_dt_s * np.arange(n_frames)[:, None]
    pos = start + speed * time[:, :, None]
    vel = np.repeat(speed[None], n_frames, axis=0)
    up, down = 9.81 * (1 + damping), 9.81 * (1 - damping)
    turn = np.maximum(speed[:, 2], 0.0) / up
    before, after = np.minimum(time, turn), np.maximum(time - turn, 0.0)
    speed_at_turn = speed[:, 2] - up * turn
    pos[:, :, 2] = start[:, 2] + speed[:, 2] * before - up / 2 * before**2 + speed_at_turn * after - down / 2 * after**2
    vel[:, :, 2] = speed[:, 2] - up * before - down * after
    write_case(path, flight, pos, vel)
    return flight


def heap_case(path: Path, kind: str, angle_deg: float, n_frames: int = 12, n_in_flight: int = 0) -> Scene:
    """A bed at rest whose surface stands at `angle_deg`; the scene reads its angle of repose from half time on.

    Args:
        kind: `plane` (a wedge that rises along y, the axis along x) or `radial` (a cone about z).
        n_in_flight: grains that hang in the air over the bed and are no part of it.
    """
    step, slope = 1.9 * RADIUS_M, np.tan(np.radians(angle_deg))  # neighbours along the slope touch
    ticks = step * np.arange(-6, 7)
    x, y = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    top = slope * y if kind == "plane" else -slope * np.hypot(x, y)
    columns = [np.stack([x, y, top - layer * step], axis=1) for layer in range(3)]
    flying = np.stack([np.linspace(-0.1, 0.1, n_in_flight), np.zeros(n_in_flight), np.full(n_in_flight, 0.3)], axis=1)
    frame = np.concatenate([*columns, flying])
    heap = scene(
        len(frame), n_frames, angle_of_repose={"kind": kind, "from_s": 0.005 * (n_frames - 1), "axis": [1.0, 0.0, 0.0]}
    )
    write_case(path, heap, np.repeat(frame[None], n_frames, axis=0))
    return heap


def rotating_box_case(path: Path, n_outside: int = 0, n_frames: int = 21, rate_rad_s: float = 8.0) -> Scene:
    """Grains that turn rigidly with a box (0.4 x 0.2 x 0.2 m) about x; the first `n_outside` sit just outside it.

    Grains fill the box into its corners, so that they are inside only in the box's own frame.
    """
    motion = {"kind": "rotation", "axis": [1.0, 0.0, 0.0], "rate_rad_s": rate_rad_s}
    shape = {"kind": "box", "size_m": [0.4, 0.2, 0.2]}
    grid = [np.linspace(-half, half, n) for half, n in ((0.18, 4), (0.08, 3), (0.08, 3))]
    body = np.stack([axis.ravel() for axis in np.meshgrid(*grid)], axis=1)
    body[:n_outside, 1] = 0.12
    turning = scene(
        len(body),
        n_frames,
        boundary={"drum": {"shape": shape, "points": 200, "friction_angle_rad": 0.5, "motion": motion}},
    )
    angle = rate_rad_s * turning.frame_dt_s * np.arange(n_frames)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    pos = np.stack(
        [
            np.broadcast_to(body[:, 0], (n_frames, len(body))),
            cosine * body[:, 1] - sine * body[:, 2],
            sine * body[:, 1] + cosine * body[:, 2],
        ],
        axis=2,
    )
    ang_vel = np.broadcast_to([rate_rad_s, 0.0, 0.0], pos.shape)
    write_case(path, turning, pos, np.cross(ang_vel, pos), ang_vel)
    return turning


def passing_case(path: Path, n_falling: int = 8, n_frames: int = 31) -> Scene:
    """Grains far apart that fall out through an outlet, one after the other, while two enter through an inlet.

    Nothing touches, so every grain flies freely while it is there; the highest one stays to the end. Grain radii are
    5 and 10 mm.
    """
    inlet = {"count": 2, "rate_per_s": 10.0, "center_m": [0.0, 1.0, 0.3], "size_m": [0.1, 0.1]}
    count = n_falling + inlet["count"]
    changes: dict[str, Any] = {
        "boundary": {},
        "outlet": {"point_m": [0.0, 0.0, -0.15], "normal": [0.0, 0.0, -1.0]},
        "inlet": inlet | {"velocity_m_s": [0.0, 0.0, -1.0]},
    }
    passing = scene(count, n_frames, **changes)
    passing.grains.radius_m = [RADIUS_M, RADIUS_M / 2]
    time = passing.frame_dt_s * np.arange(n_frames)[:, None]
    plan, drop = entries(passing), np.linspace(0.4, -0.1, n_falling)
    start = np.concatenate([np.stack([0.1 * np.arange(n_falling), 0 * drop, drop], axis=1), plan.pos])
    speed = np.concatenate([np.zeros((n_falling, 3)), plan.vel])
    entered_s = np.concatenate([np.zeros(n_falling), plan.time_s])
    flown = np.maximum(time - entered_s, 0.0)[:, :, None]
    gravity = np.array(passing.gravity_m_s2)
    pos = start + speed * flown + gravity / 2 * flown**2
    active = (time >= entered_s - 1e-9) & (pos[:, :, 2] > -0.15)
    vel, first = speed + gravity * flown, active.argmax(axis=0)
    for frame in range(1, len(pos)):
        left = ~active[frame] & ~active[frame - 1] & (frame > first)
        pos[frame, left] = pos[frame - 1, left]
    write_case(path, passing, pos, np.where(active[:, :, None], vel, 0.0), active=active)
    return passing

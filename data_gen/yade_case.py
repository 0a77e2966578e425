"""Runs one case inside Yade's own Python: `yade -n -x -j1 data_gen/yade_case.py JOB ROOT`.

JOB is a folder that data_gen/dem.py filled, ROOT the folder that holds the package gns_pyg.

Prints `frame K N SECONDS` after every stored frame; everything else that Yade prints is chatter.
"""

import json
import math
import os
import shutil
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import h5py  # noqa: F401
import numpy as np
import yade.config
from yade import O, utils
from yade.wrapper import (
    Bo1_Facet_Aabb,
    Bo1_Sphere_Aabb,
    ForceResetter,
    FrictMat,
    Ig2_Facet_Sphere_ScGeom,
    Ig2_Sphere_Sphere_ScGeom,
    InsertionSortCollider,
    InteractionLoop,
    Ip2_FrictMat_FrictMat_FrictPhys,
    Law2_ScGeom_FrictPhys_CundallStrack,
    NewtonIntegrator,
    RotationEngine,
    TranslationEngine,
)

sys.path.append(sys.argv[2])  # last: where ROOT is a site-packages folder, numpy and h5py must stay Yade's own
from gns_pyg import machine
from gns_pyg.data.trajectory import TrajectoryWriter
from gns_pyg.scene.travel import travel

BLOCKED = 0.1  # of the radius: a grain that enters and overlaps another one by more stops the run


def rotate(points: np.ndarray, axis: list, origin: list, angle: float) -> np.ndarray:
    """Turns points (..., 3) by `angle`, rad, about the line through `origin` along `axis` (Rodrigues' formula)."""
    axis = np.array(axis) / np.linalg.norm(axis)
    arm = points - origin
    turned = arm * np.cos(angle) + np.cross(axis, arm) * np.sin(angle)
    return origin + turned + np.multiply.outer(arm @ axis, axis) * (1 - np.cos(angle))


def material(values: dict, friction_angle_rad: float) -> FrictMat:
    return FrictMat(
        density=values["density_kg_m3"],
        young=values["young_modulus_pa"],
        poisson=values["poisson_ratio"],
        frictionAngle=friction_angle_rad,
    )


class MovingPart:
    """The facets of a moving part and the engine that moves them."""

    def __init__(self, ids: list, motion: SimpleNamespace, axis: np.ndarray) -> None:
        self.motion = motion
        if motion.kind == "rotation":
            origin = motion.origin_m
            self.engine = RotationEngine(ids=ids, rotationAxis=axis.tolist(), zeroPoint=origin, rotateAroundZero=True)
        else:
            self.engine = TranslationEngine(ids=ids, translationAxis=axis.tolist())
        self.varies = motion.function is not None or motion.kind == "oscillation"
        if not self.varies:  # once: the last digits of a mean speed per step would change every drum run
            self._set(travel(motion, 1.0, math))

    def step(self, time_s: float, dt_s: float) -> None:
        """Sets the mean speed of the step from `time_s` on where it varies: so the pose at its end is exact."""
        if self.varies:
            self._set((travel(self.motion, time_s + dt_s, math) - travel(self.motion, time_s, math)) / dt_s)

    def _set(self, speed: float) -> None:
        if self.motion.kind == "rotation":
            self.engine.angularVelocity = speed
        else:
            self.engine.velocity = speed


def add_part(part: dict, triangles: np.ndarray, grain_material: dict, time_s: float) -> list:
    """Adds the facets of a part in its pose at `time_s`; returns its `MovingPart` if it moves."""
    motion = SimpleNamespace(**part["motion"])
    moves = motion.kind != "none"
    if moves:
        axis, come = np.array(motion.axis) / np.linalg.norm(motion.axis), travel(motion, time_s, math)
        if motion.kind == "rotation":
            triangles = rotate(triangles, motion.axis, motion.origin_m, come)
        else:
            triangles = triangles + come * axis
    wall = material(grain_material, part["friction_angle_rad"])
    ids = O.bodies.append([utils.facet(corners.tolist(), material=wall) for corners in triangles])
    return [MovingPart(ids, motion, axis)] if moves else []


class Grains:
    """The grains of a case: those in Yade, those that have left and those that will enter."""

    def __init__(self, scene: dict, arrays: dict, start: int) -> None:
        values = scene["grains"]["material"]
        self.scene, self.material = scene, material(values, values["friction_angle_rad"])
        self.radius = arrays["radius"]
        self.pos, self.vel, self.ang_vel = (arrays[name][start].copy() for name in ("pos", "vel", "ang_vel"))
        self.active = arrays["active"][start].astype(bool)
        self.entries = [arrays[f"entry_{name}"] for name in ("time_s", "pos", "vel")]
        self.first_entry = len(self.radius) - len(self.entries[0])
        there = np.flatnonzero(self.active).tolist()
        ids = O.bodies.append([self._sphere(grain) for grain in there])
        self.bodies = {grain: O.bodies[i] for grain, i in zip(there, ids, strict=True)}

    def frame(self, time_s: float, dt_s: float) -> None:
        """Reads all grains, then lets those out that are beyond the outlet and those in whose time has come."""
        there, states = list(self.bodies), [body.state for body in self.bodies.values()]
        for array, name in ((self.pos, "pos"), (self.vel, "vel"), (self.ang_vel, "angVel")):
            vectors = (getattr(state, name) for state in states)
            components = [(vector[0], vector[1], vector[2]) for vector in vectors]  # not np.array: ten times as long
            array[there] = np.array(components).reshape(-1, 3)
        if (outlet := self.scene["outlet"]) is not None:
            beyond = (self.pos - outlet["point_m"]) @ np.array(outlet["normal"]) > 0
            for grain in np.flatnonzero(beyond & self.active).tolist():
                O.bodies.erase(self.bodies.pop(grain).id)
                self.active[grain], self.vel[grain], self.ang_vel[grain] = False, 0, 0
        times, pos, vel = self.entries
        for entry in np.flatnonzero((times > time_s - dt_s + 1e-9) & (times <= time_s + 1e-9)).tolist():
            self._enter(self.first_entry + entry, pos[entry], vel[entry], time_s)

    def _enter(self, grain: int, pos: np.ndarray, vel: np.ndarray, time_s: float) -> None:
        gap = np.linalg.norm(self.pos[self.active] - pos, axis=1) - self.radius[self.active] - self.radius[grain]
        if len(gap) and gap.min() < -BLOCKED * self.radius[grain]:
            raise SystemExit(
                f"scene.inlet is blocked at t = {time_s:g} s: grain {grain} would enter {-gap.min():.3g} m deep in "
                "another one; lower scene.inlet.rate_per_s or move the inlet away"
            )
        self.pos[grain], self.vel[grain], self.active[grain] = pos, vel, True
        self.bodies[grain] = O.bodies[O.bodies.append(self._sphere(grain))]

    def _sphere(self, grain: int) -> object:
        body = utils.sphere(self.pos[grain].tolist(), float(self.radius[grain]), material=self.material)
        body.state.vel, body.state.angVel = self.vel[grain].tolist(), self.ang_vel[grain].tolist()
        return body


def steps_per_frame(scene: dict, smallest_radius_m: float) -> int:
    """Whole number of DEM steps in a frame, none longer than the scene's time step; `auto` is a third of the time that
    a pressure wave takes through the smallest grain (Yade's PWaveTimeStep)."""
    dt, values = scene["dem"]["dt_s"], scene["grains"]["material"]
    wave_s = smallest_radius_m * math.sqrt(values["density_kg_m3"] / values["young_modulus_pa"])
    longest = wave_s / 3 if dt == "auto" else float(dt)
    return int(np.ceil(scene["frame_dt_s"] / longest * (1 - 1e-9)))


def run(folder: Path) -> None:
    job = json.loads((folder / "job.json").read_text())
    scene = job["scene"]
    with np.load(folder / "arrays.npz") as archive:
        arrays = dict(archive)
    shutil.rmtree(folder, ignore_errors=True)  # all is read; nothing is left over if both processes are killed
    boundary = {}
    for name, part in scene["boundary"].items():
        vertices, triangles = arrays[f"vertices/{name}"], arrays[f"triangles/{name}"]
        boundary[name] = {"vertices": vertices, "triangles": triangles, "motion": part["motion"]}
    times_s, n_frames, step = arrays["time_s"].tolist(), job["n_frames"], 0
    mass = scene["grains"]["material"]["density_kg_m3"] * 4 / 3 * np.pi * arrays["radius"] ** 3
    passing, decimals = scene["outlet"] is not None or scene["inlet"] is not None, scene["dem"]["decimals"]
    clock = Clock()
    with TrajectoryWriter(
        job["path"], scene, arrays["radius"], mass, boundary, decimals, with_active=passing
    ) as writer:
        for number, start_s in enumerate(times_s):
            grains, moving, per_frame = build(scene, arrays, boundary, number)
            for frame in range(n_frames):
                now_s = start_s + frame * scene["frame_dt_s"]
                if frame:
                    clock.run(per_frame, moving, start_s)
                    grains.frame(now_s, scene["frame_dt_s"])
                    step += per_frame
                writer.append(step, now_s, grains.pos, grains.vel, grains.ang_vel, grains.active)
                done = number * n_frames + frame + 1
                print("frame", done, len(times_s) * n_frames, f"{clock.wall_s:.3f}", flush=True)
                if os.getppid() != job["parent"]:
                    raise SystemExit("the process that started this run is gone: stopping")
        writer.finish(
            {
                "case": job["case"],
                "seed": scene["seed"],
                "wall_clock_s": clock.wall_s,
                "cpu_time_s": clock.cpu_s,
                "cores": job["cores"],
                "steps": step,
                "dt_s": O.dt,
                "creator": "Yade",
                "creator_version": str(yade.config.version),
                "processor": machine.processor(),
                **job["facts"],
            }
        )


class Clock:
    """Steps Yade and adds up what the stepping takes."""

    def __init__(self) -> None:
        self.wall_s = self.cpu_s = 0.0

    def run(self, steps: int, moving: list, from_s: float) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(steps):  # O.run(n, wait=True) polls every 40 ms and would spoil the clock
            for part in moving:
                part.step(from_s + O.time, O.dt)
            O.step()
        self.wall_s += time.perf_counter() - wall
        self.cpu_s += time.process_time() - cpu


def build(scene: dict, arrays: dict, boundary: dict, number: int) -> tuple:
    """Fills an empty Yade with the start `number`; returns its grains, its moving parts and the steps of a frame."""
    O.reset()
    moving = []
    for name, part in scene["boundary"].items():
        triangles = boundary[name]["vertices"][boundary[name]["triangles"]]
        moving += add_part(part, triangles, scene["grains"]["material"], float(arrays["time_s"][number]))
    grains = Grains(scene, arrays, number)
    per_frame = steps_per_frame(scene, grains.radius.min())
    O.dt = scene["frame_dt_s"] / per_frame
    O.engines = [
        ForceResetter(),
        InsertionSortCollider(
            [Bo1_Sphere_Aabb(), Bo1_Facet_Aabb()],
            verletDist=scene["dem"]["verlet_distance_ratio"] * float(grains.radius.min()),
        ),
        InteractionLoop(
            [Ig2_Sphere_Sphere_ScGeom(), Ig2_Facet_Sphere_ScGeom()],
            [Ip2_FrictMat_FrictMat_FrictPhys()],
            [Law2_ScGeom_FrictPhys_CundallStrack()],
        ),
        *[part.engine for part in moving],
        NewtonIntegrator(
            gravity=scene["gravity_m_s2"], damping=scene["damping"], dampGravity=scene["damping_on_gravity"]
        ),
    ]
    return grains, moving, per_frame


run(Path(sys.argv[1]))

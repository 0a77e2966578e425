"""Runs one case inside Yade's own Python: `yade -n -x -j1 data_gen/yade_case.py JOB ROOT`.

JOB is a folder that data_gen/dem.py filled, ROOT the folder that holds the package gns_pyg.

Prints `frame K N SECONDS` after every stored frame; everything else that Yade prints is chatter.
"""

import json
import os
import shutil
import sys
import time
from pathlib import Path

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
)

sys.path.append(sys.argv[2])  # last: where ROOT is a site-packages folder, numpy and h5py must stay Yade's own
from gns_pyg import machine
from gns_pyg.data.trajectory import TrajectoryWriter


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


def add_part(part: dict, triangles: np.ndarray, grain_material: dict, time_s: float) -> list:
    """Adds the facets of a part in its pose at `time_s`; returns the engines that move it."""
    motion = part["motion"]
    moves = motion["kind"] == "rotation" and motion["rate_rad_s"] != 0
    if moves:
        triangles = rotate(triangles, motion["axis"], motion["origin_m"], motion["rate_rad_s"] * time_s)
    wall = material(grain_material, part["friction_angle_rad"])
    ids = O.bodies.append([utils.facet(corners.tolist(), material=wall) for corners in triangles])
    if not moves:
        return []
    engine = RotationEngine(
        ids=ids,
        rotationAxis=motion["axis"],
        zeroPoint=motion["origin_m"],
        rotateAroundZero=True,
        angularVelocity=motion["rate_rad_s"],
    )
    return [engine]


def add_grains(scene: dict, arrays: dict) -> list:
    """Adds the grains with their velocities and spins; returns Yade's bodies in order."""
    grain_material = scene["grains"]["material"]
    grain = material(grain_material, grain_material["friction_angle_rad"])
    bodies = []
    for pos, vel, ang_vel in zip(arrays["pos"], arrays["vel"], arrays["ang_vel"], strict=True):
        body = utils.sphere(pos.tolist(), scene["grains"]["radius_m"], material=grain)
        body.state.vel, body.state.angVel = vel.tolist(), ang_vel.tolist()
        bodies.append(body)
    return [O.bodies[i] for i in O.bodies.append(bodies)]


def steps_per_frame(scene: dict) -> int:
    """Whole number of DEM steps in a frame, none longer than the scene's time step."""
    dt = scene["dem"]["dt_s"]
    longest = utils.PWaveTimeStep() / 3 if dt == "auto" else float(dt)
    return int(np.ceil(scene["frame_dt_s"] / longest * (1 - 1e-9)))


def run(folder: Path) -> None:
    job = json.loads((folder / "job.json").read_text())
    scene, time_s = job["scene"], job["time_s"]
    with np.load(folder / "arrays.npz") as archive:
        arrays = dict(archive)
    shutil.rmtree(folder, ignore_errors=True)  # all is read; nothing is left over if both processes are killed
    boundary, moving = {}, []
    for name, part in scene["boundary"].items():
        vertices, triangles = arrays[f"vertices/{name}"], arrays[f"triangles/{name}"]
        boundary[name] = {"vertices": vertices, "triangles": triangles, "motion": part["motion"]}
        moving += add_part(part, vertices[triangles], scene["grains"]["material"], time_s)
    grains = add_grains(scene, arrays)
    per_frame = steps_per_frame(scene)
    O.dt = scene["frame_dt_s"] / per_frame
    O.engines = [
        ForceResetter(),
        InsertionSortCollider(
            [Bo1_Sphere_Aabb(), Bo1_Facet_Aabb()],
            verletDist=scene["dem"]["verlet_distance_ratio"] * scene["grains"]["radius_m"],
        ),
        InteractionLoop(
            [Ig2_Sphere_Sphere_ScGeom(), Ig2_Facet_Sphere_ScGeom()],
            [Ip2_FrictMat_FrictMat_FrictPhys()],
            [Law2_ScGeom_FrictPhys_CundallStrack()],
        ),
        *moving,
        NewtonIntegrator(
            gravity=scene["gravity_m_s2"], damping=scene["damping"], dampGravity=scene["damping_on_gravity"]
        ),
    ]
    n_frames, n_grains = job["n_frames"], len(grains)
    radius = np.array([body.shape.radius for body in grains])
    mass = np.array([body.state.mass for body in grains])
    decimals = scene["dem"]["decimals"]
    wall_clock_s = cpu_time_s = 0.0
    with TrajectoryWriter(job["path"], scene, radius, mass, boundary, decimals) as writer:
        for frame in range(n_frames):
            if frame:
                wall, cpu = time.perf_counter(), time.process_time()
                for _ in range(per_frame):  # O.run(n, wait=True) polls every 40 ms and would spoil the clock
                    O.step()
                wall_clock_s += time.perf_counter() - wall
                cpu_time_s += time.process_time() - cpu
            # Yade hands out live references: without np.array every frame would hold the last one's values.
            states = [body.state for body in grains]
            pos, vel, ang_vel = (
                np.array([np.array(getattr(state, name)) for state in states]).reshape(n_grains, 3)
                for name in ("pos", "vel", "angVel")
            )
            writer.append(frame * per_frame, time_s + frame * scene["frame_dt_s"], pos, vel, ang_vel)
            print("frame", frame + 1, n_frames, f"{wall_clock_s:.3f}", flush=True)
            if os.getppid() != job["parent"]:
                raise SystemExit("the process that started this run is gone: stopping")
        writer.finish(
            {
                "case": job["case"],
                "seed": scene["seed"],
                "wall_clock_s": wall_clock_s,
                "cpu_time_s": cpu_time_s,
                "cores": job["cores"],
                "steps": (n_frames - 1) * per_frame,
                "dt_s": O.dt,
                "creator": "Yade",
                "creator_version": str(yade.config.version),
                "processor": machine.processor(),
            }
        )


run(Path(sys.argv[1]))

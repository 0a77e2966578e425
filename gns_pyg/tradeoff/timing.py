"""Times, all points side by side in one run: networks and Yade by turns, one thread each, round after round."""

import logging
import multiprocessing
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig

from gns_pyg import machine
from gns_pyg.config import require
from gns_pyg.data.datamodule import open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.evaluation.predict import initial_state, roll_out, start_frame
from gns_pyg.tradeoff import dem
from gns_pyg.tradeoff.job import folder_of, simulator_of
from gns_pyg.tradeoff.points import NETWORKS, Point, cases_of, points, scene_of
from gns_pyg.tradeoff.rows import row_of

log = logging.getLogger(__name__)


def times(cfg: DictConfig) -> dict[str, Any]:
    """Times every finished point that can be run on the first unseen case, `cfg.rounds` rounds; writes time.json beside
    each row.

    Returns:
        Name of the point -> what was written.
    """
    require(isinstance(cfg.rounds, int) and cfg.rounds >= 1, "rounds", cfg.rounds, "at least 1", "3 gives a median")
    todo = [
        p for p in points(cfg) if p.kind in (*NETWORKS, "yade") and (row_of(cfg, p) or {"error": ""})["error"] is None
    ]
    case = cases_of(cfg).test[0]
    measured: dict[Point, list[dict[str, float]]] = {point: [] for point in todo}
    for number in range(cfg.rounds):
        for point in todo:
            measured[point].append(apart(lambda point=point: once(cfg, point, case)))  # type: ignore[misc]
        log.info("round %d of %d", number + 1, cfg.rounds)
    found = {}
    for point, rounds in measured.items():
        told = {key: median(each[key] for each in rounds) for key in rounds[0]} | {
            "rounds": [each["cpu_s_per_simulated_s"] for each in rounds],
            "threads": 1,
            "processor": machine.processor(),
        }
        write_json(folder_of(cfg, point) / "time.json", told)
        found[point.name] = told
    return found


def once(cfg: DictConfig, point: Point, case: Trajectory) -> dict[str, float]:
    """One roll-out of a point. Per simulated second: processor and wall seconds of the stepping; `first_step_s`, the
    first step's wall seconds, what is set up then included; `peak_memory_mib` of the process that computes."""
    if point.kind == "yade":
        step = point.training[0] if point.training[0] == "auto" else float(point.training[0])
        done = dem.from_start(case, cfg.start_s, step)
        span_s = (len(done.pos) - 1) * case.frame_dt_s
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        return _figures(done.cpu_s / span_s, done.wall_s / span_s, 0.0, children)
    torch.set_num_threads(1)
    simulator = simulator_of(cfg, point)
    scene = replace(scene_of(cfg), frame_dt_s=simulator.scene.frame_dt_s)
    own = open_to_compare(case.path, scene)
    start = start_frame(own, cfg.start_s)
    begin = time.perf_counter()
    with torch.inference_mode():
        simulator(initial_state(simulator, own, start))
    first_s = time.perf_counter() - begin
    span_s = (own.n_frames - 1 - start) * own.frame_dt_s
    cpu = time.process_time()
    wall = roll_out(simulator, own, start)[1]
    cpu_s = time.process_time() - cpu
    return _figures(cpu_s / span_s, wall, first_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def _figures(cpu: float, wall: float, first_s: float, peak_kib: int) -> dict[str, float]:
    return {
        "cpu_s_per_simulated_s": cpu,
        "wall_s_per_simulated_s": wall,
        "first_step_s": first_s,
        "peak_memory_mib": peak_kib / 1024,
    }


def apart(function: Callable[[], dict[str, float]]) -> dict[str, float]:
    """The result of `function`, called in a fork: its memory is its own, and gone afterwards."""
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)
    process = fork.Process(target=lambda: sender.send(function()))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        raise RuntimeError("a timed roll-out ended early; its error stands above") from None
    finally:
        process.join()

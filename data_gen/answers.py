"""What does the DEM do where a model got itself? `python -m data_gen.answers bundle=runs/.../bundle out=...`.

A roll-out soon visits states that no DEM run visits: grains that hover, overlap, have lost their speed. What should
follow there no recorded case says. So the DEM is asked: it starts from states of roll-outs of the training cases and
runs one frame from each. Training on its answers beside the recorded cases (`data.answers`) teaches a model the DEM's
physics where it will need it; a few rounds of training and asking follow each other (Ross et al. 2011, "A reduction of
imitation learning and structured prediction to no-regret online learning"). Config: conf/answers.yaml.
"""

import logging
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from trimesh import Trimesh

from data_gen.continuation import DECIMALS
from data_gen.dem import run_dem
from data_gen.initial import Start
from gns_pyg import bundle
from gns_pyg.config import require
from gns_pyg.data.datamodule import open_cases
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import NumericalError
from gns_pyg.evaluation.predict import initial_state, start_frame
from gns_pyg.launch import launch
from gns_pyg.run import load_bundle
from gns_pyg.scene.scene import Scene

log = logging.getLogger(__name__)


def answers(cfg: DictConfig) -> dict[str, Any]:
    """Rolls the bundle out from every case that it was trained on, asks the DEM, writes a file per case unless it is
    there already: frames 2 k are states of the roll-out, frames 2 k + 1 the DEM's, one frame later.

    Returns:
        The `files`, and `states`: how many were answered this time.

    Raises:
        GnsError: for a bundle or cases that cannot be used, a model whose state is not `full`, Yade missing or failing.
    """
    simulator = load_bundle(cfg)
    require(cfg.out is not None, "out", "null", "a folder", "e.g. out=data/hopper_small_answers/1")
    every = cfg.every
    apart = isinstance(every, int) and every >= 2
    require(apart, "every", every, "at least 2", "an answer must lie between two states")
    state = simulator.requires.state
    require(state == "full", "bundle", f"a model of state {state}", "one of the full state", "the DEM needs all of it")
    known = set(bundle.card(cfg.bundle)["cases"]["train"].values())
    cases = [case for case in open_cases(simulator.scene, cfg.data.dir) if case.content_hash() in known]
    require(bool(cases), "data.dir", "none of the cases", "cases that the bundle was trained on", "name their folder")
    files, n_states = [], 0
    for case in cases:
        files.append(Path(cfg.out) / case.path.name.replace("case", "answers"))
        if files[-1].exists():
            log.info("%s: already there, nothing to do", files[-1])
            continue
        starts = own_states(simulator, case, start_frame(case, cfg.start_s), every)
        scene = Scene.from_config(case.scene)
        fine = replace(scene, dem=replace(scene.dem, decimals=DECIMALS))
        meshes = {n: Trimesh(part["vertices"], part["triangles"], process=False) for n, part in case.boundary.items()}
        facts = {"rolled_out_from": case.content_hash()}
        run_dem(fine, meshes, starts, files[-1], case.run["case"], n_frames=2, facts=facts)
        n_states += len(starts)
        log.info("%s: %d states answered", files[-1], len(starts))
    return {"files": [str(file) for file in files], "states": n_states}


def own_states(simulator: Simulator, case: Trajectory, start: int, every: int) -> list[Start]:
    """States of a roll-out from the recorded frame `start`, every so many steps; if it diverges, those before."""
    state, found = initial_state(simulator, case, start), []
    steps = rollout(simulator, state.to(simulator.scale.device), case.n_frames - 1 - start)
    try:
        for after in islice(steps, every - 1, None, every):
            now = after.to("cpu")
            if now.ang_vel is None:
                break
            there = torch.ones_like(now.batch, dtype=torch.bool) if now.active is None else now.active
            pos, vel, ang_vel, active = (x.numpy().copy() for x in (now.pos, now.vel, now.ang_vel, there))
            found.append(Start(pos, vel, ang_vel, case.radius, active, float(now.time_s[0])))
    except NumericalError as error:
        require(bool(found), "bundle", str(error), "a roll-out that holds for a while", "train longer first")
        log.warning("%s: only the states before are asked for", error)
    return found


if __name__ == "__main__":
    launch("answers", answers)

"""The measured lines: figures without a pass mark. Each takes a `Bench` and returns (None, figures)."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch

from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.evaluation.contacts import mean_overlap_ratio
from gns_pyg.evaluation.gradients import gradient_norms
from gns_pyg.evaluation.predict import initial_state, start_frame, steps_per_frame
from gns_pyg.evaluation.stress import Bench, Verdict, kinetic_energy, last, masses, steps
from gns_pyg.evaluation.twins import read_twins
from gns_pyg.state import State

SHARE_OF_RADIUS = 0.01  # two roll-outs have parted when their mean distance is this part of a radius
FAR = 100  # times the length of the training cases
PRECISIONS: dict[str, torch.dtype | None] = {"float32": None, "bfloat16": torch.bfloat16, "float16": torch.float16}


def precisions(bench: Bench) -> Verdict:
    """Fewer bits: the error of a step, and when a roll-out parts from that with float64 networks."""
    double = deepcopy(bench.simulator).double()
    frames = range(start_frame(bench.case, bench.start_s), bench.case.n_frames - 1, 10 if bench.full else 60)
    per_frame, dt_s = steps_per_frame(bench.simulator, bench.case), bench.simulator.scene.frame_dt_s
    n = round((bench.case.times_s[-1] - float(bench.start.time_s[0])) / dt_s) if bench.full else 20
    exact = [state.pos for state in steps(double, bench.start, n)]
    error_m = _one_step_m(bench, double, frames, per_frame)
    told = [f"one step of {bench.case.frame_dt_s:g} s: float64 {1e3 * error_m:.4f} mm"]
    for name, cast in PRECISIONS.items():
        with _autocast(cast):
            error_m = _one_step_m(bench, bench.simulator, frames, per_frame)
            distances = [
                float(torch.linalg.vector_norm(state.pos - pos, dim=1).mean())
                for state, pos in zip(steps(bench.simulator, bench.start, n), exact, strict=True)
            ]
        parts = np.flatnonzero(np.array(distances) > SHARE_OF_RADIUS * float(bench.start.radius[0]))
        when = f"parts at step {parts[0] + 1}" if len(parts) else "does not part"
        told.append(f"{name}: {1e3 * error_m:.4f} mm, {when} of {n}, {1e3 * distances[-1]:.1f} mm away at the end")
    twins = read_twins(bench.case, bench.case.times_s[start_frame(bench.case, bench.start_s) :])
    if twins is not None and bench.full:
        told.append(f"DEM twins at the end {1e3 * twins.mean_m[-1]:.1f} mm")
    told.append("TF32 and run-to-run differences: on a GPU only, not checked")
    return None, "; ".join(told)


def ledgers(bench: Bench) -> Verdict:
    """Energy and momentum of a step from DEM's own states, beside what DEM's step does."""
    simulator, case, per_frame = bench.simulator, bench.case, steps_per_frame(bench.simulator, bench.case)
    model_j, dem_j, pairs = [], [], []
    for frame in range(start_frame(case, bench.start_s), case.n_frames - 1, 5 if bench.full else 40):
        before, following = initial_state(simulator, case, frame), initial_state(simulator, case, frame + 1)
        after = last(simulator, before, per_frame)
        model_j.append(_energy(simulator, after) - _energy(simulator, before))
        dem_j.append(_energy(simulator, following) - _energy(simulator, before))
        pairs.append(_momentum_lost(simulator, before))
    total_j = _energy(simulator, bench.start)
    return None, (
        f"energy per {case.frame_dt_s:g} s step (kinetic, of spin and potential; {total_j:.3g} J at the start): "
        f"network {np.mean(model_j):+.2e} +- {np.std(model_j):.1e} J, "
        f"DEM {np.mean(dem_j):+.2e} +- {np.std(dem_j):.1e} J; "
        f"momentum that grain-grain contacts create, over what they exchange: {np.mean(pairs):.1e} (DEM 0)"
    )


def gradients(bench: Bench) -> Verdict:
    """Gradients through unrolled steps."""
    counts = (1, 3, 10, 30, 100) if bench.full else (1, 3)
    norms = gradient_norms(bench.simulator, bench.middle, counts)
    found = ", ".join(f"{n}: {norm:.3g}" for n, norm in norms.items())
    return None, f"norm of d(sum of squared positions)/d(positions at the start), m, after so many steps: {found}"


def far(bench: Bench) -> Verdict:
    """A hundred times the trained length."""
    simulator, scene = bench.simulator, bench.simulator.scene
    n = round((FAR if bench.full else 0.2) * float(bench.case.times_s[-1]) / scene.frame_dt_s)
    told, density, radius = [], scene.grains.material.density_kg_m3, bench.start.radius.numpy()
    marks = {max(1, round(n * part)) for part in (0.01, 0.03, 0.1, 0.3, 1.0)}
    escaped = 0
    for number, state in enumerate(steps(simulator, bench.start, n), 1):
        if number in marks:
            pos = state.pos[None].numpy()
            escaped = max(escaped, bench.escaped(state))
            told.append(
                f"{number * scene.frame_dt_s:.3g} s: kinetic {kinetic_energy(state, density):.2e} J, overlap "
                f"{100 * float(mean_overlap_ratio(pos, radius)[0]):.2f} %, deepest in a wall "
                f"{100 * _deepest(simulator, state):.1f} % of a diameter"
            )
    return None, f"{n * scene.frame_dt_s:g} s: finite, {escaped} escaped; " + "; ".join(told)


MEASURED: dict[str, Callable[[Bench], Verdict]] = {
    "fewer bits": precisions,
    "energy and momentum": ledgers,
    "gradients through steps": gradients,
    "a hundred times the trained length": far,
}


def _autocast(dtype: torch.dtype | None) -> AbstractContextManager:
    return nullcontext() if dtype is None else torch.autocast("cpu", dtype)


def _one_step_m(bench: Bench, simulator: Simulator, frames: range, per_frame: int) -> float:
    """Mean position error, m, one recorded frame after every frame of `frames`."""
    errors = []
    for frame in frames:
        after = last(simulator, initial_state(simulator, bench.case, frame), per_frame)
        truth = torch.from_numpy(bench.case.read("position", frame + 1, frame + 2)[0])
        errors.append(float(torch.linalg.vector_norm(after.pos - truth, dim=1).mean()))
    return float(np.mean(errors))


def _energy(simulator: Simulator, state: State) -> float:
    """Kinetic energy of translation and rotation, and potential energy of gravity, J."""
    density = simulator.scene.grains.material.density_kg_m3
    mass = masses(state, density)
    gravity = torch.tensor(simulator.scene.gravity_m_s2, dtype=torch.float64)
    spin_j = 0.0
    if state.ang_vel is not None:
        spin_j = float((0.4 * mass * state.radius**2 * state.ang_vel.square().sum(1) / 2).sum())
    return kinetic_energy(state, density) + spin_j - float((mass * (state.pos @ gravity)).sum())


def _momentum_lost(simulator: Simulator, state: State) -> float:
    """|sum of the momentum changes that the grain network makes| over the sum of their magnitudes."""
    with torch.inference_mode():
        graph = replace(simulator.graph(state), walls=None)
        effect = simulator.effects(state, replace(graph, wall_edges=graph.wall_edges[:, :0]))
    group = slice(3, 6) if simulator.integrator.n_groups > 1 else slice(0, 3)  # the change of velocity
    change = (effect * simulator.scale)[:, group].double() * state.radius[:, None] ** 3
    size = float(torch.linalg.vector_norm(change, dim=1).sum())
    return float(torch.linalg.vector_norm(change.sum(0))) / size if size else 0.0


def _deepest(simulator: Simulator, state: State) -> float:
    """The deepest that a grain reaches through a wall's nearest boundary point's plane, of its diameter."""
    if simulator.boundary is None:
        return 0.0
    walls, (point, grain) = simulator.boundary.contacts(state)
    height = ((state.pos[grain] - walls.pos[point]) * walls.normal[point]).sum(1)
    near = torch.linalg.vector_norm(state.pos[grain] - walls.pos[point], dim=1) < 1.2 * state.radius[grain]
    depth = ((state.radius[grain] - height) / (2 * state.radius[grain]))[near]
    return float(depth.max().clamp(min=0)) if len(depth) else 0.0

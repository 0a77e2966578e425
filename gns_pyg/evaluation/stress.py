"""Trained simulators at the extremes: lines that must hold, each a function of a `Bench`, and how they are run."""

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch

from gns_pyg.data.datamodule import open_condition
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.rollout import rollout
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import GnsError
from gns_pyg.evaluation.predict import initial_state, start_frame
from gns_pyg.scene.containment import outside
from gns_pyg.state import State


@dataclass(frozen=True)
class Line:
    """One line of the verdict.

    Attributes:
        line: what was tried.
        hard: whether it must hold; the others are figures without a mark.
        holds: whether it does; None for a figure, or where it could not be tried here (`found` says why).
        found: the figures.
        seconds: processor time that it took.
    """

    line: str
    hard: bool
    holds: bool | None
    found: str
    seconds: float = 0.0

    def plain(self) -> dict[str, Any]:
        return asdict(self)


Verdict = tuple[bool | None, str]


@dataclass
class Bench:
    """What the lines are tried on.

    Attributes:
        simulator: what is tried.
        case: a recorded case of its scene that it was not trained on.
        covered: what its training cases covered (see `data.coverage`); empty for an untrained one.
        full: roll-outs at full length, a million grains; else a short form of the same.
        start_s: where roll-outs begin in the case.
        curves: name -> curve for the picture, filled by the lines.
    """

    simulator: Simulator
    case: Trajectory
    covered: Mapping[str, Sequence[float]] = field(default_factory=dict)
    full: bool = True
    start_s: float = 0.1
    curves: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def start(self) -> State:
        """The recorded state where roll-outs begin."""
        return initial_state(self.simulator, self.case, start_frame(self.case, self.start_s))

    @cached_property
    def middle(self) -> State:
        """A recorded state in the middle of the case, when most grains touch others."""
        return initial_state(self.simulator, self.case, self.case.n_frames // 2)

    def recorded(self, kind: str) -> Trajectory | None:
        """The first embedded DEM run of the scene that is `long`, or with walls that are `still`, or None."""
        own = self.simulator.scene
        found = open_condition(f"{own.name}_{kind}", own.frame_dt_s)
        return None if found is None else found[1][0]

    def escaped(self, state: State, simulator: Simulator | None = None) -> int:
        """Grains outside the boundary."""
        scene = (simulator or self.simulator).scene
        found = 0
        for graph, time_s in enumerate(state.time_s.tolist()):
            pos = state.pos[state.batch == graph]
            found += int(outside(pos[None].numpy(), np.array([time_s]), scene).sum())
        return found


def run_lines(
    bench: Bench, lines: Mapping[str, Callable[[Bench], Verdict]], hard: bool, names: Sequence[str] = ()
) -> Iterator[Line]:
    """Tries lines one after the other; one that raises an error does not hold."""
    for name, line in lines.items():
        if names and not any(part.lower() in name.lower() for part in names):
            continue
        begin = time.process_time()
        try:
            holds, found = line(bench)
        except GnsError as error:
            holds, found = False, " ".join(f"{type(error).__name__}: {error}".split())
        except Exception:
            holds, found = False, traceback.format_exc(limit=-3).strip()
        yield Line(name, hard, holds if hard or holds is False else None, found, time.process_time() - begin)


def steps(simulator: Simulator, state: State, n: int) -> Iterator[State]:
    """The `n` states that follow, every one of them checked for finite values."""
    simulator.check_place(state)
    return rollout(simulator, state, n, settles=simulator.settles)


def last(simulator: Simulator, state: State, n: int) -> State:
    """The state `n` steps on."""
    for following in steps(simulator, state, n):
        state = following
    return state


def finite(state: State) -> bool:
    """Whether every value is."""
    fields = (state.pos, state.vel, state.ang_vel)
    return all(values is None or bool(torch.isfinite(values).all()) for values in fields)


def masses(state: State, density_kg_m3: float) -> torch.Tensor:
    """Of every grain, kg, (n,)."""
    return density_kg_m3 * 4 / 3 * torch.pi * state.radius**3


def kinetic_energy(state: State, density_kg_m3: float) -> float:
    """Of translation, J."""
    return float((masses(state, density_kg_m3) * state.vel.square().sum(1) / 2).sum())

"""A simulator against the DEM runs it has never seen."""

from collections.abc import Sequence

import numpy as np

from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.evaluation.baselines import FIRST_FRAME, Climatology
from gns_pyg.evaluation.metrics import CaseResult, Evaluation, case_result, evaluate_cases
from gns_pyg.evaluation.predict import one_step_errors, roll_out, start_frame


def judge(simulator: Simulator, cases: Sequence[Trajectory], climatology: Climatology, start_s: float) -> Evaluation:
    """Rolls every case out from `start_s`, predicts single steps along it, and compares both with DEM.

    Raises:
        NumericalError: if a roll-out diverges; names step, field and grain.
    """
    results = [compare(simulator, case, start_s) for case in cases]
    return evaluate_cases(results, climatology, simulator.scene)


def compare(simulator: Simulator, case: Trajectory, start_s: float) -> CaseResult:
    """The roll-out and the single steps of one case, beside DEM.

    Raises:
        NumericalError: see `judge`.
    """
    start = start_frame(case, start_s)
    return judge_rollout(simulator, case, start, *roll_out(simulator, case, start))


def judge_rollout(
    simulator: Simulator, case: Trajectory, start: int, pos: np.ndarray, seconds_per_simulated_second: float
) -> CaseResult:
    """Puts a finished roll-out from the case's frame `start`, positions (n_frames - start, n_grains, 3), m, beside DEM,
    with single steps along the whole case."""
    errors = one_step_errors(simulator, case)
    return case_result(case, simulator.scene, pos, start, errors, FIRST_FRAME, seconds_per_simulated_second)

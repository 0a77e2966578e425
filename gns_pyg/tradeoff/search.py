"""A search with Optuna that spends its trials near the front: time against errors in centre of mass and angle.

Its study is Optuna's own file in the results folder, so several processes may search together, a stopped one goes on,
and every tool for studies reads it. Each trial is a point like any other, with a row like any other in that folder; the
table holds the sweeps' points alone.
"""

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gns_pyg.config import plain, require
from gns_pyg.errors import DependencyError
from gns_pyg.tradeoff.axes import axes_of
from gns_pyg.tradeoff.front import OBSERVED, seconds
from gns_pyg.tradeoff.job import do
from gns_pyg.tradeoff.points import Point, cases_of, points, sweep_values
from gns_pyg.tradeoff.rows import row_of
from gns_pyg.tradeoff.timing import apart, once

log = logging.getLogger(__name__)


def search(cfg: DictConfig) -> list[dict[str, Any]]:
    """Runs `cfg.trials` trials within `cfg.search`; what the table holds of these values already, timed, is told to
    Optuna first.

    Returns:
        The trials on the study's front: `values` (s per simulated second, then the errors) and `params`.

    Raises:
        DependencyError: without Optuna.
        ConfigError: for an empty search.
    """
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError:
        raise DependencyError("stage=search", "no optuna", "Optuna", "pip install 'gns_pyg[optuna]'") from None
    told_space = [str(text).partition("=") for text in plain(cfg.search)]
    space = {key: sweep_values(key, values) for key, _, values in told_space}
    known = bool(space) and all(len(values) > 1 for values in space.values())
    require(known, "search", cfg.search, "key=value,value,... of train.py", "see conf/tradeoff/tradeoff.yaml")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    path = Path(cfg.results) / "optuna.log"
    path.parent.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(path))),
        study_name=f"{cfg.experiment}, {cfg.budget_cpu_s} s, {', '.join(map(str, cfg.search))}",
        sampler=optuna.samplers.TPESampler(seed=cfg.seed),
        directions=["minimize"] * (1 + len(OBSERVED)),
        load_if_exists=True,
    )
    choices: Any = {key: optuna.distributions.CategoricalDistribution(values) for key, values in space.items()}
    told = {trial.user_attrs.get("name") for trial in study.trials}
    for point in points(cfg):
        row, params = row_of(cfg, point), params_of(point, space)
        if row is not None and params is not None and point.name not in told and _complete(values := goals(row)):
            attrs = {"name": point.name}
            study.add_trial(optuna.create_trial(params=params, distributions=choices, values=values, user_attrs=attrs))

    def objective(trial: Any) -> list[float]:
        point = point_of({key: trial.suggest_categorical(key, values) for key, values in space.items()}, space)
        trial.set_user_attr("name", point.name)
        row = do(cfg, point)
        if row is None or row["error"] is not None:
            raise optuna.TrialPruned
        case = cases_of(cfg).test[0]
        values = goals(row | {"time": apart(lambda: once(cfg, point, case))})
        if not _complete(values):
            raise optuna.TrialPruned
        log.info("%s: %s", point.name, ", ".join(f"{value:.3g}" for value in values))
        return values

    study.optimize(objective, n_trials=cfg.trials)
    return [{"values": trial.values, "params": trial.params} for trial in study.best_trials]


def goals(row: Mapping[str, Any]) -> list[float]:
    """What the search minimises."""
    axes = axes_of(row)
    return [seconds(row), *(axes.get(axis, {}).get("mean", math.inf) for axis in OBSERVED)]


def _complete(values: list[float]) -> bool:
    return all(value is not None and math.isfinite(value) for value in values)


def point_of(params: Mapping[str, str], space: Mapping[str, list[str]]) -> Point:
    """The point of chosen values; a default (the first of its values) is left out, as it is in the sweeps."""
    return Point("trained", tuple(f"{key}={value}" for key, value in params.items() if value != space[key][0]))


def params_of(point: Point, space: Mapping[str, list[str]]) -> dict[str, str] | None:
    """A point's values in the space; None for one outside it."""
    told = dict(text.split("=", 1) for text in point.training)
    inside = point.kind == "trained" and all(key in space and value in space[key] for key, value in told.items())
    return {key: told.get(key, values[0]) for key, values in space.items()} if inside else None

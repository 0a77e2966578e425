"""What to run: a sentence for a person who has an error they can live with or a time they can wait."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gns_pyg import machine
from gns_pyg.config import plain, require
from gns_pyg.errors import DataError
from gns_pyg.tradeoff.axes import AXES
from gns_pyg.tradeoff.front import OBSERVABLES, Row, choose, equivalent_yade, error, scatter, seconds

log = logging.getLogger(__name__)


def read_table(path: str | Path, scene: str) -> list[dict[str, Any]]:
    """The rows of a scene of a stored table.

    Raises:
        DataError: if there is no such table, or nothing of that scene in it.
    """
    path, make = Path(path), "make it: python tradeoff.py experiment=..., then stage=time, then stage=table"
    try:
        tables = json.loads(path.read_text())
        return tables[scene]
    except OSError as error:
        raise DataError(path, str(error), "a table of a trade-off", make) from None
    except ValueError as error:
        raise DataError(path, f"not JSON: {error}", "a table of a trade-off", make) from None
    except (KeyError, TypeError):
        known = ", ".join(tables) if isinstance(tables, dict) else type(tables).__name__
        raise DataError(path, f"nothing of {scene}; it holds {known}", f"rows of {scene}", make) from None


def recommend(cfg: DictConfig) -> dict[str, Any]:
    """Prints what to run within the limits of `cfg`, and what it costs; returns the row.

    Raises:
        DataError: without a table.
        ConfigError: without a limit; for a limit on what is no axis; or if nothing measured is within the limits.
    """
    rows = read_table(cfg.table, cfg.experiment)
    limits = {
        str(key).removeprefix("max_"): value
        for key, value in plain(cfg).items()
        if str(key).startswith("max_") and value is not None
    }
    for key, value in limits.items():
        known = isinstance(value, int | float) and value >= 0
        require(known, f"max_{key}", value, "a number, at least 0", "see conf/tradeoff/recommend.yaml for the units")
    most_s = limits.pop("seconds", None)
    most_s = None if most_s is None else float(most_s)
    row = choose(rows, cfg.simulated_s, most_s, limits)
    if row is None:
        wanted = ", ".join(
            [*([f"{most_s:g} s"] if most_s is not None else []), *(f"{k} {v:g}" for k, v in limits.items())]
        )
        raise _nothing(rows, wanted, cfg.simulated_s)
    log.info("%s", sentence(row, rows, cfg.experiment, cfg.simulated_s))
    return dict(row)


def _nothing(rows: Sequence[Row], wanted: str, simulated_s: float) -> DataError:
    yade = equivalent_yade(rows)
    remedy = "allow more error or more time"
    if yade is not None:
        remedy += f"; {yade['name']} takes {seconds(yade) * simulated_s:.3g} s"
    return DataError("recommend", f"nothing measured is within {wanted}", "a row within the limits", remedy)


def sentence(row: Row, rows: Sequence[Row], experiment: str, simulated_s: float) -> str:
    """The answer, in words."""
    took, measured_on = seconds(row) * simulated_s, row["time"]["processor"]
    lines = [
        f"{advice(row, experiment)}",
        f"  {took:.3g} s for {simulated_s:g} simulated s ({seconds(row):.3g} s each), one thread of {measured_on}",
        *(f"  {line}" for line in told(row)),
        "  no one can tell it from DEM by one run: all observables within the scatter between seeds"
        if row["within_scatter"]
        else "  outside the scatter between DEM seeds in " + ", ".join(outside(row, rows)),
    ]
    yade = equivalent_yade(rows)
    if yade is not None:
        factor = seconds(yade) / seconds(row)
        lines.append(f"  against {yade['name']} (the largest step that shows the same): {factor:.3g} times as fast")
    if (pays := row.get("break_even_rollouts")) is not None:
        lines.append(f"  pays back Yade's training cases and its own training after so many roll-outs: {pays}")
    if measured_on != machine.processor():
        lines.append(f"  measured on {measured_on}, not here ({machine.processor()}): measure again for times")
    return "\n".join(lines)


def advice(row: Row, experiment: str) -> str:
    """The command."""
    if row["kind"] == "yade":
        step = row["training"][0]
        case = f"python -m data_gen.generate scene={experiment}_small scene.dem.dt_s={step}"
        return f"run Yade with dt = {step} instead of a network: {case}"
    options = " ".join(row["running"])
    if row["kind"] == "shipped":
        return f"python rollout.py bundle={row['training'][0]} {options}".rstrip()
    trained = " ".join([f"experiment={experiment}", *row["training"], f"training.updates={row.get('updates', '...')}"])
    return f"python train.py {trained}; then python rollout.py bundle=... {options}".rstrip()


def told(row: Row) -> list[str]:
    """Every axis that the row tells: mean, and the range over cases."""
    found = []
    for name, axis in AXES.items():
        if values := row["axes"].get(name):
            mean, least, most = (axis.factor * values[key] for key in ("mean", "least", "most"))
            found.append(f"{axis.title}: {mean:.3g} ({least:.3g} to {most:.3g})")
    return found


def outside(row: Row, rows: Sequence[Row]) -> list[str]:
    """The observables in which a row's error is larger than what DEM seeds differ by."""
    return [AXES[axis].title for axis, limit in scatter(rows, OBSERVABLES).items() if error(row, axis) > limit]

"""What a trained model has cost, and after how many roll-outs it has paid for itself."""

import math
from collections.abc import Mapping
from typing import Any

NOT_RECORDED = "not recorded in this bundle"


def break_even(cost: Mapping[str, Any] | None, metrics: Mapping[str, Any], duration_s: float) -> list[tuple[str, str]]:
    """Rows (what, value) of the speed table's second half.

    Args:
        cost: of a bundle's card: `dem_s`, seconds of Yade for the cases it was trained and validated on and for the
            answers, and `training_s`, wall seconds of training (None where an earlier round did not record it); None
            for a bundle made before costs were kept.
        metrics: `speed/seconds_per_simulated_second` and `speed/yade_seconds_per_simulated_second`.
        duration_s: simulated seconds of a whole run.
    """
    dem_s, training_s = (None, None) if cost is None else (cost.get("dem_s"), cost.get("training_s"))
    saved_s = duration_s * (
        metrics["speed/yade_seconds_per_simulated_second"] - metrics["speed/seconds_per_simulated_second"]
    )
    rows = [
        ("Yade for the training cases", _seconds(dem_s)),
        ("training", _seconds(training_s)),
        (f"saved by a roll-out of {duration_s:g} s", f"{saved_s:.3g} s"),
    ]
    if saved_s <= 0:
        verdict = "never: the network is slower than Yade here"
    elif dem_s is None or training_s is None:
        verdict = f"not known: costs {NOT_RECORDED}"
    else:
        verdict = f"after {math.ceil((dem_s + training_s) / saved_s):,} roll-outs"
    return [*rows, ("has paid for itself", verdict)]


def _seconds(value: float | None) -> str:
    return NOT_RECORDED if value is None else f"{value:.3g} s"

"""The long fuzz run: `python -m tests.fuzz [EXAMPLES]` (about half an hour on a core) writes docs/fuzz.json."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from gns_pyg.evaluation.metrics import write_json
from tests.fuzz import examples
from tests.fuzz.step import check

RESULT = Path(__file__).parents[2] / "docs" / "fuzz.json"
SHARE_SHIPPED = 20  # one in so many is of a shipped bundle
PHASES = [Phase.generate, Phase.shrink]


def fuzz(choices: Sequence[Any], build: Callable[[Any], examples.Subject], n: int) -> dict[str, object]:
    """Takes `n` steps; an example that fails ends the run with its smallest form."""
    counts: Counter[str] = Counter()
    grains, began = 0, time.monotonic()

    @seed(n)
    @settings(max_examples=n, deadline=None, database=None, phases=PHASES, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def steps(data: st.DataObject) -> None:
        nonlocal grains
        subject = build(data.draw(st.sampled_from(choices)))
        state = data.draw(examples.states(subject))
        check(subject.simulator, state, counts)
        grains += len(state.pos)
        if (done := sum(counts.values())) % 500 == 0:
            print(f"{done} of {n}, {time.monotonic() - began:.0f} s, {dict(counts)}", flush=True)

    steps()
    passed = counts.pop("passed", 0)
    return {
        "examples": passed + sum(counts.values()),
        "passed": passed,
        "refused": dict(counts),
        "grains": grains,
        "wall_s": round(time.monotonic() - began, 1),
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 21_000
    found = {
        "untrained": fuzz(examples.SETUPS, examples.untrained, n - n // SHARE_SHIPPED),
        "shipped": fuzz(examples.BUNDLES, examples.shipped, n // SHARE_SHIPPED),
    }
    print(found)
    write_json(RESULT, found)

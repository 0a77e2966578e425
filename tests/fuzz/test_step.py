"""A short, repeatable version of the long fuzz run (`python -m tests.fuzz`)."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import examples
from tests.fuzz.step import check

short = settings(deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))


def run(choices: Sequence[Any], build: Callable[[Any], examples.Subject], n: int) -> Counter[str]:
    counts: Counter[str] = Counter()

    @settings(short, max_examples=n)
    @given(st.data())
    def steps(data: st.DataObject) -> None:
        subject = build(data.draw(st.sampled_from(choices)))
        check(subject.simulator, data.draw(examples.states(subject)), counts)

    steps()
    return counts


def test_any_finite_state_gives_a_finite_step_or_an_error_of_ours():
    counts = run(examples.SETUPS[:40], examples.untrained, 120)
    assert counts["passed"] >= 60, "refusing everything is no answer"


def test_so_do_the_shipped_bundles():
    counts = run(examples.BUNDLES, examples.shipped, 12)
    assert counts["passed"] >= 6

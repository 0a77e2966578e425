"""A short, repeatable version of the long fuzz run (`python -m tests.fuzz`)."""

from collections import Counter

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import examples
from tests.fuzz.step import check

short = settings(deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))


def run(subjects: st.SearchStrategy[examples.Subject], n: int) -> Counter[str]:
    counts: Counter[str] = Counter()

    @settings(short, max_examples=n)
    @given(st.data())
    def steps(data: st.DataObject) -> None:
        subject = data.draw(subjects)
        check(subject.simulator, data.draw(examples.states(subject)), counts)

    steps()
    return counts


def test_any_finite_state_gives_a_finite_step_or_an_error_of_ours():
    counts = run(st.sampled_from(examples.SETUPS[:40]).map(examples.untrained), 120)
    assert counts["passed"] >= 60, "refusing everything is no answer"


def test_so_do_the_shipped_bundles():
    counts = run(st.sampled_from(examples.BUNDLES).map(examples.shipped), 12)
    assert counts["passed"] >= 6

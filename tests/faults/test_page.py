"""The committed figures of the long fault run, and the page that tells them."""

import json

from tests.faults.page import PAGE, RESULT, with_figures

FOUND = json.loads(RESULT.read_text())


def test_the_page_tells_the_committed_figures():
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_figures(page, FOUND)


def test_nothing_was_lost_and_nothing_let_in():
    assert FOUND["kills"] == FOUND["kills_recovered"] >= 200
    assert FOUND["mutated_files"] >= 10_000
    assert FOUND["unexpected_errors"] == 0
    assert set(FOUND["killed"]) == {"training", "roll-out", "report", "sweep", "data generation"}
    assert not any(of["wrong"] for of in FOUND["killed"].values())
    assert all(of["files"] == of["opened"] + of["refused"] for of in FOUND["opened"].values())

"""The committed figures of the long fault run, and the page that tells them."""

import json

from tests.faults.page import PAGE, RESULT, with_figures

FOUND = json.loads(RESULT.read_text())


def test_the_page_tells_the_committed_figures():
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_figures(page, FOUND)


def test_all_that_was_killed_recovered():
    assert FOUND["kills"] == FOUND["kills_recovered"] >= 200
    assert not any(of["wrong"] for of in FOUND["killed"].values())


def test_no_damaged_file_came_through():
    assert FOUND["mutated_files"] >= 10_000
    assert FOUND["unexpected_errors"] == 0


def test_every_file_is_accounted_for():
    for of in FOUND["opened"].values():
        assert of["files"] == of["opened"] + of["refused"] + len(of["unexpected"])

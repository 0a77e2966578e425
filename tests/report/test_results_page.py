"""The generated results page: figures as they are, verdicts as the goals say."""

import json
from pathlib import Path

import pytest

from gns_pyg.report.results_page import results_page

STORED = json.loads((Path(__file__).parents[2] / "docs" / "results.json").read_text())


def test_the_committed_page_is_that_of_the_committed_figures():
    assert (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8") == results_page(STORED)


def test_every_picture_of_the_page_is_there():
    docs = Path(__file__).parents[2] / "docs"
    pictures = [line.split("](")[1].rstrip(")") for line in results_page(STORED).splitlines() if line.startswith("![")]
    assert pictures
    assert all((docs / picture).is_file() for picture in pictures)


@pytest.mark.parametrize(
    ("key", "value", "row"),
    [
        ("test/one_step_error_m", 3.1e-4, "one-step error"),
        ("test/center_of_mass_error_max_m", 4.1e-3, "centre of mass, largest"),
        ("test/rollout_error_over_twin", 0.84, "roll-out error, last frame"),
        ("test/horizon_s", 1e-3, "predictability horizon"),
        ("test/angle_of_repose_deg", 90.0, "angle of repose"),
        ("test/mean_speed_m_s", 0.1, "mean speed"),
        ("test/granular_temperature_m2_s2", 1e-5, "granular temperature"),
        ("test/mean_overlap_ratio", 0.1, "mean overlap"),
        ("test/overlap_ratio_999", 0.5, "overlap, 99.9th percentile"),
        ("test/escaped_grains", 1, "grains lost"),
    ],
)
def test_a_missed_goal_says_no(key, value, row):
    scene = STORED["hopper_small"]
    changed = {"hopper_small": scene | {"metrics": scene["metrics"] | {key: value}}}
    line = next(line for line in results_page(changed).splitlines() if line.startswith(f"| {row}"))
    assert line.endswith("**no** |")


@pytest.mark.parametrize(
    ("off", "said"),
    [
        ([0.1, -0.1, 0.0, 0.2], "+0.05 ± 0.21 degrees off (95 %, 4 cases); within 1 degree: yes"),
        ([1.1, 0.9, 1.0, 1.2], "within 1 degree: **no**"),  # well known, and too much
        ([3.0, -3.0, 0.0], "within 1 degree: **no**"),  # right on average, hardly known
        ([0.1, -0.1], None),
    ],
)
def test_angles_of_long_runs_are_held_against_one_degree_from_three_cases_on(off, said):
    case = STORED["drum"]["long"]["cases"][0]
    cases = [case | {"angle_of_repose_deg": case["angle_of_repose_dem_deg"] + by} for by in off]
    page = results_page({"drum": STORED["drum"] | {"long": {"cases": cases}}})
    assert ("Angle of repose in long runs" in page) == (said is not None)
    assert said is None or said in page


@pytest.mark.parametrize(
    ("off", "said"), [([0.1, -0.1, 0.0, 0.2], "+0.1 ± 0.2"), ([1.5, -0.5, 1.4, -0.4], "+0.5 ± 1.7")]
)
def test_the_angle_of_three_cases_or_more_is_as_well_known_as_they_agree(off, said):
    scene = STORED["hopper"]
    cases = [
        case | {"test/angle_of_repose_deg": case["test/angle_of_repose_dem_deg"] + by}
        for case, by in zip(scene["cases"], off, strict=True)
    ]
    line = next(
        row for row in results_page({"hopper": scene | {"cases": cases}}).splitlines() if row.startswith("| angle")
    )
    assert f"{said} off (95 %, 4 cases)" in line
    assert line.endswith("**no** |") == (said == "+0.5 ± 1.7")

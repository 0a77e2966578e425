"""Figures and pages from the table alone."""

import re

from gns_pyg.tradeoff.pictures import STYLES, YARDSTICKS, draw, write_page
from gns_pyg.tradeoff.tables import page
from tests.tradeoff.samples import row, seeds, yade

ROWS = [
    seeds() | {"front": False},
    yade(1e-4, 2.0, 0.005, front=True),
    row("width </script> 16", 0.5, 0.05, 5.0, updates=7, front=True, break_even_rollouts="never", budget_cpu_s=100),
    row("failed", None, error="it\nbroke", front=False),
]


def test_every_told_axis_is_a_panel():
    titles = [axes.get_title(loc="left") for axes in draw(ROWS, "hopper").axes]
    assert titles == ["centre of mass, mm", "angle of repose, degrees", "escaped grains"]


def test_the_page_needs_nothing_from_elsewhere_and_no_name_ends_its_script(tmp_path):
    write_page(tmp_path / "page.html", ROWS, "hopper")
    text = (tmp_path / "page.html").read_text()
    assert not re.search(r'(src|href)="', text)
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    assert text.count("</script>") == 2
    assert "failed" not in text


def test_the_table_has_every_row_and_says_why_one_failed():
    text = page({"hopper": ROWS})
    assert "| F | width </script> 16 | 0.5 |" in text
    assert "- failed: failed. it broke" in text
    assert "Yade's largest step that shows the same: Yade, dt = 0.0001 s." in text
    assert "within what seeds differ by: none." in text
    near = [*ROWS, row("near", 1.0, 0.005, 0.5, front=True, budget_cpu_s=100, break_even_rollouts="never")]
    assert "differ by: near, 2 times as fast as Yade, dt = 0.0001 s" in page({"hopper": near})
    assert "so it never pays." in page({"hopper": near})


def test_every_colour_is_one_that_browsers_know():
    assert all(
        re.fullmatch("#[0-9a-f]{6}", color, re.IGNORECASE) for _, color, _ in (*STYLES.values(), *YARDSTICKS.values())
    )

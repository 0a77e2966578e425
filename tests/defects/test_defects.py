"""The deliberate defects fit today's code, and the committed run of them (`python -m tests.defects`) caught each."""

import json
import os
import subprocess
import sys

import pytest

from tests.defects.catalogue import DEFECTS, ROOT

TWO = """
from dataclasses import replace
from tests.defects.campaign import campaign
from tests.defects.catalogue import DEFECTS
defect = next(defect for defect in DEFECTS if defect.name == "spins mirrored like velocities")
found = dict(campaign([defect, none := replace(defect, name="no defect", new=defect.old)]))
assert found == {defect: defect.tests[0], none: None}, found
"""


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_a_defect_fits_the_code_and_names_tests_that_exist(defect):
    assert defect.applied(ROOT) != (ROOT / defect.file).read_text()
    for test in defect.tests:
        file, *_, name = test.split("::")
        assert f"def {name}(" in (ROOT / file).read_text()


def test_the_committed_run_caught_every_defect():
    stored = json.loads((ROOT / "docs" / "defects.json").read_text())
    assert set(stored["defects"]) == {defect.name for defect in DEFECTS}, "run python -m tests.defects again"
    assert stored["caught"] == len(DEFECTS)
    for defect in DEFECTS:
        assert stored["defects"][defect.name]["caught_by"].startswith(defect.tests)


def test_a_defect_is_caught_and_none_is_not():
    done = subprocess.run(
        [sys.executable, "-c", TWO],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr

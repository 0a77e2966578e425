"""Runs named tests on a copy of the project, with a defect or without."""

import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.defects.catalogue import ROOT, Defect, tests_of

COPIED = ("gns_pyg", "data_gen", "conf", "tests", "pyproject.toml")
FAILED = 1  # pytest's exit status where tests ran and some failed


class Seen:
    """A plugin that notes which tests failed, and how many ran."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.passed = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)
        self.passed += report.when == "call" and report.passed


@contextmanager
def copy_of_project() -> Iterator[Path]:
    """A temporary copy of the code and its tests; the embedded cases are the tree's own."""
    with tempfile.TemporaryDirectory(prefix="gns_defects_") as folder:
        root = Path(folder)
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                ignored = shutil.ignore_patterns("embedded", "__pycache__")
                shutil.copytree(source, root / name, symlinks=True, ignore=ignored)
            else:
                shutil.copyfile(source, root / name)
        (root / "data_gen" / "embedded").symlink_to(ROOT / "data_gen" / "embedded")
        yield root


def run(root: Path, tests: Iterable[str]) -> tuple[int, list[str], int]:
    """Runs tests in a fork of this process, which must not have imported the project; returns pytest's exit status,
    the tests that failed, and how many passed."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        status = 3
        try:
            os.close(reader)
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            os.chdir(root)
            for name in [name for name in sys.modules if name.split(".")[0] in ("tests", "gns_pyg", "data_gen")]:
                del sys.modules[name]
            sys.path.insert(0, str(root))
            sys.dont_write_bytecode = True
            seen = Seen()
            status = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests], plugins=[seen]))
            os.write(writer, "\n".join([str(seen.passed), *seen.failed]).encode())
        except BaseException:
            os.write(writer, f"0\n{traceback.format_exc()[-500:]}".encode())
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        passed, *failed = pipe.read().splitlines() or ["0"]
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), failed, int(passed)


def campaign(defects: list[Defect]) -> Iterator[tuple[Defect, str | None]]:
    """Shows that the named tests pass without a defect, then applies each to the copy alone.

    Yields:
        Each defect and the first test that failed; None if it was not caught: tests passed, or could not run at all.

    Raises:
        RuntimeError: if a named test fails, or does not exist, without a defect.
    """
    with copy_of_project() as root:
        status, failed, passed = run(root, tests_of(defects))
        if status or passed < len(tests_of(defects)):
            raise RuntimeError(f"without a defect pytest ends with status {status}, {passed} passed; failed: {failed}")
        for defect in defects:
            path = root / defect.file
            sound = path.read_text()
            path.write_text(defect.applied(root))
            status, failed, _ = run(root, defect.tests)
            path.write_text(sound)
            yield defect, failed[0] if status == FAILED and failed else None

"""The machine: memory that is kept, threads that wait briefly."""

import os
import platform
import subprocess
import sys

import pytest

from gns_pyg import launch, machine

FAULTS = """
import resource, torch
from gns_pyg.machine import keep_memory
keep_memory()
for turn in range(16):
    if turn == 8:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    [torch.ones(300_000) for _ in range(200)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library than glibc: memory is not kept")
def test_memory_that_is_kept_is_not_mapped_anew():
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 500  # of 468,800 pages; nearly all of them where memory is not kept


def test_every_command_keeps_memory(monkeypatch):
    kept = []
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # as `launch` leaves it
    monkeypatch.setattr(launch, "keep_memory", lambda: kept.append(True))
    monkeypatch.setattr(launch.hydra, "main", lambda **_: lambda _: lambda: None)
    launch.launch("train", print)
    assert kept


@pytest.mark.skipif(sys.platform != "linux", reason="torch waits otherwise there: the setting is of GNU's OpenMP")
@pytest.mark.parametrize(
    ("told", "spins"), [({}, "10000"), ({"GOMP_SPINCOUNT": "70"}, "70"), ({"OMP_WAIT_POLICY": "passive"}, "0")]
)
def test_a_command_s_threads_wait_briefly_and_nobody_else_s(told, spins):
    show = "import os, gns_pyg.cli; print(os.environ.get('GOMP_SPINCOUNT'))"
    free = {key: value for key, value in os.environ.items() if key not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    env = free | told | {"OMP_DISPLAY_ENV": "verbose"}
    done = subprocess.run([sys.executable, "-c", show], env=env, capture_output=True, text=True, check=True)
    assert f"GOMP_SPINCOUNT = '{spins}'" in done.stderr
    assert done.stdout.strip() == str(told.get("GOMP_SPINCOUNT"))


@pytest.mark.parametrize(("vendor", "expected"), [("GenuineIntel", True), ("AuthenticAMD", False), ("", False)])
def test_whose_processor_it_is(monkeypatch, vendor, expected):
    monkeypatch.setattr(machine, "_said", {"vendor_id": vendor}.get)
    assert machine.by_intel() is expected

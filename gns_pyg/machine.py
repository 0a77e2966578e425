"""The machine that figures were measured on, its memory and its threads.

Standard library alone: Yade's Python imports it too.
"""

import ctypes
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's numbers for them, malloc.h
SPINS = "GOMP_SPINCOUNT"


def processor() -> str:
    """The processor's name, `unknown` where the system does not tell."""
    return _said("model name") or "unknown"


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 itself (x86: AVX512 or AMX)."""
    return bool({"avx512_bf16", "amx_bf16"} & set(_said("flags").split()))


def by_intel() -> bool:
    """Whether Intel made the processor; its own library, MKL, looks for that."""
    return _said("vendor_id") == "GenuineIntel"


def _said(key: str) -> str:
    """What the system says of the first processor, "" where it does not."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(key)), "")


def peak_memory_mb() -> float:
    """The most memory that this process has held so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def keep_memory() -> None:
    """This process keeps the memory that it frees, in blocks of up to 32 MiB, for its next use, where its C library is
    glibc, which else hands it back to the system, to be cleared and mapped anew at every step of many grains."""
    with suppress(OSError, AttributeError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(MMAP_THRESHOLD, 32 * 2**20)  # the most that glibc takes
        library.mallopt(TRIM_THRESHOLD, -1)


@contextmanager
def brief_waits() -> Iterator[None]:
    """Where torch is loaded within, its threads look 10,000 times whether the others are done before they sleep, not
    300,000 times: a thread that has lost its core to another program is waited for at every product. What the user set
    holds; processes that this one starts are left as they are."""
    ours = not {SPINS, "OMP_WAIT_POLICY"} & os.environ.keys()
    if ours:
        os.environ[SPINS] = "10000"
    try:
        yield
    finally:
        if ours:
            del os.environ[SPINS]

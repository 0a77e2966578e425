"""The machine that figures were measured on, and its memory. Standard library alone: Yade's Python imports it too."""

import ctypes
import resource
from contextlib import suppress
from pathlib import Path

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's numbers for them, malloc.h


def processor() -> str:
    """The processor's name, `unknown` where the system does not tell."""
    return _said("model name") or "unknown"


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 itself (x86: AVX512 or AMX)."""
    return bool({"avx512_bf16", "amx_bf16"} & set(_said("flags").split()))


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

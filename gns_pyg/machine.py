"""The machine that figures were measured on. Standard library alone: Yade's Python imports it too."""

import resource
from pathlib import Path


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

"""The machine that figures were measured on. Standard library alone: Yade's Python imports it too."""

from pathlib import Path


def processor() -> str:
    """The processor's name, `unknown` where the system does not tell."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")

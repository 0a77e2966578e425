"""The figures in docs/reliability.md, from docs/reliability.json."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

RESULT = Path(__file__).parents[2] / "docs" / "reliability.json"
PAGE = RESULT.with_suffix(".md")
BEGIN, END = "<!-- figures: written by python -m tests.faults -->\n", "<!-- end of figures -->\n"


def with_figures(page: str, found: Mapping[str, Any]) -> str:
    """The page with its figures exchanged for those of `found`."""
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    return before + BEGIN + tables(found) + END + after


def tables(found: Mapping[str, Any]) -> str:
    killed = [f"| {name} | {of['kills']} | {of['recovered']} |" for name, of in found["killed"].items()]
    opened = [
        f"| {name} | {of['files']} | {of['refused']} | {of['opened']} | {len(of['unexpected'])} | "
        f"{of['peak_memory_mb']} |"
        for name, of in found["opened"].items()
    ]
    lines = [
        "| killed | kills | recovered |",
        "|---|---|---|",
        *killed,
        f"| **all** | **{found['kills']}** | **{found['kills_recovered']}** |",
        "",
        "| damaged or hostile | files | refused in our words | opened, sound | anything else | peak memory, MB |",
        "|---|---|---|---|---|---|",
        *opened,
        f"| **all** | **{found['mutated_files']}** | | | **{found['unexpected_errors']}** | "
        f"**{found['peak_memory_mb']}** |",
    ]
    return "\n".join(lines) + "\n"

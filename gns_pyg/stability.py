"""`make stability`: collects the verdicts of the shipped bundles as docs/stability.json and puts their tables and
pictures into docs/stability.md, between its marks. What the page says around them is written by hand."""

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gns_pyg.bundle import SHIPPED
from gns_pyg.errors import DataError
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.files import whole
from gns_pyg.report.verdict import verdict_markdown


def collect(runs: Path, docs: Path, shipped: Path = SHIPPED) -> dict[str, Any]:
    """Reads runs/<bundle>/stability.json of every bundle, writes stability.json, stability.md and the pictures, and
    puts each verdict into the bundle of that name, whose pages show it. Verdicts of other bundles stay.

    Raises:
        DataError: if there is none.
    """
    paths = sorted(runs.glob("*/stability.json"))
    if not paths:
        raise DataError(runs, "no stability.json", "the folders of stress.py runs", "make stability")
    found = {path.parent.name: json.loads(path.read_text()) for path in paths}
    for path in paths:
        picture = path.parent / "plots" / "stability.png"
        if picture.is_file():
            shutil.copyfile(picture, docs / "figures" / f"stability_{path.parent.name}.png")
    plain = {name: {key: value for key, value in entry.items() if key != "curves"} for name, entry in found.items()}
    stored = docs / "stability.json"
    before = json.loads(stored.read_text()) if stored.is_file() else {}
    write_json(stored, before | plain)
    for name, entry in plain.items():
        if (shipped / name).is_dir():
            write_json(shipped / name / "stability.json", entry)
    page = docs / "stability.md"
    text = with_tables(page.read_text(encoding="utf-8"), found)
    with whole(page) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return found


def with_tables(page: str, found: Mapping[str, Any]) -> str:
    """The page with the table of every bundle in place of what stood between its marks."""
    for name, entry in found.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        table = verdict_markdown(entry["lines"])
        before, _, rest = page.partition(begin)
        _, _, after = rest.partition(end)
        page = f"{before}{begin}{table}\n{end}{after}"
    return page


if __name__ == "__main__":
    collect(Path(sys.argv[1]), Path(sys.argv[2]))

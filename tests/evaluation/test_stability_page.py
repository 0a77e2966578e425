import json

import pytest

from gns_pyg.errors import DataError
from gns_pyg.stability import collect

LINE = {"line": "NaN and infinity", "hard": True, "holds": True, "found": "refused by name", "seconds": 1.0}


def verdict(found):
    return {"bundle": "x", "scene": "x", "form": "full", "processor": "x", "lines": [{**LINE, "found": found}]}


def run(folder, name, found):
    (folder / name / "plots").mkdir(parents=True)
    (folder / name / "stability.json").write_text(json.dumps({**verdict(found), "curves": {"energy": [1.0]}}))
    (folder / name / "plots" / "stability.png").write_bytes(b"picture of " + name.encode())


def test_a_verdict_takes_its_place_and_others_stay(tmp_path):
    runs, docs, shipped = (tmp_path / name for name in ("runs", "docs", "shipped"))
    (docs / "figures").mkdir(parents=True)
    (shipped / "drum").mkdir(parents=True)
    (docs / "stability.json").write_text(json.dumps({"hopper": verdict("as before")}))
    begin = "said by hand\n<!-- hopper -->\nits table\n<!-- end of hopper -->\n<!-- drum -->\n"
    end = "<!-- end of drum -->\nsaid by hand\n"
    (docs / "stability.md").write_text(f"{begin}what it was\n{end}")
    run(runs, "drum", "refused anew")
    collect(runs, docs, shipped)
    kept = json.loads((docs / "stability.json").read_text())
    assert kept == {"hopper": verdict("as before"), "drum": verdict("refused anew")}
    assert json.loads((shipped / "drum" / "stability.json").read_text()) == verdict("refused anew")
    table = "| line | verdict | found |\n|---|---|---|\n| NaN and infinity | holds | refused anew |\n"
    assert (docs / "stability.md").read_text() == begin + table + end
    assert (docs / "figures" / "stability_drum.png").read_bytes() == b"picture of drum"


def test_no_verdict_is_named(tmp_path):
    with pytest.raises(DataError, match="no stability.json"):
        collect(tmp_path, tmp_path)

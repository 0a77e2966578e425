"""A room imports only rooms below it; docs/architecture.md is the plan."""

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "gns_pyg"
GROUND = {"errors", "config", "state", "machine", "files"}
BELOW = {"errors": set(), "machine": set(), "config": {"errors"}, "state": {"errors"}, "files": {"errors"}}
BELOW |= {room: {room} | GROUND for room in ("models", "scene", "graph")}
BELOW["dynamics"] = {"dynamics", "models", "scene", "graph"} | GROUND
BELOW["data"] = {"data"} | BELOW["dynamics"]
BELOW["card"] = set()
BELOW["bundle"] = {"card"} | BELOW["dynamics"]
BELOW["evaluation"] = {"evaluation", "bundle", "card"} | BELOW["data"]
BELOW["training"] = {"training"} | BELOW["evaluation"]
BELOW["report"] = {"report"} | BELOW["evaluation"]
BELOW["results"] = {"results"} | BELOW["report"]
BELOW["stability"] = BELOW["results"]
BELOW["configuration"] = {"configuration", "training"} | BELOW["data"]
BELOW["run"] = {*BELOW, "run"}
BELOW["launch"] = {"config", "errors", "files", "machine"}
BELOW["tradeoff"] = {*BELOW, "tradeoff"} - {"results", "launch"}
BELOW["cli"] = {"run", "launch", "tradeoff", "config", "machine"}
BELOW["export"] = {"export", "launch"} | BELOW["report"]
IN_YADE = {"data/schema.py": {"errors"}, "data/trajectory.py": {"errors", "data", "files"}, "scene/travel.py": set()}
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "conf" not in path.relative_to(PACKAGE).parts)


def rooms_imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = (
                [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "gns_pyg" else [node.module]
            )
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name.split(".")[1] for name in names if name.startswith("gns_pyg."))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_room_imports_upwards(path):
    relative = path.relative_to(PACKAGE)
    room = relative.parts[0].removesuffix(".py")
    if room == "__init__":
        assert path.read_text() == ""
        return
    allowed = IN_YADE.get(str(relative), BELOW[room])
    assert set(rooms_imported(path)) <= allowed


def test_what_a_moving_wall_does_in_yade_needs_the_standard_library_alone():
    tree = ast.parse((PACKAGE / "scene" / "travel.py").read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    modules = {getattr(node, "module", None) or alias.name for node in imports for alias in node.names}
    assert {module.split(".")[0] for module in modules} <= sys.stdlib_module_names

"""What is installed is what was tested, and nothing that is read can name code."""

import ast
import tomllib
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from gns_pyg import bundle

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ASKED = [Requirement(text) for text in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"])]
CONSTRAINTS = ROOT / "constraints.txt"
PINS = {
    canonicalize_name(name): Version(pin)
    for name, _, pin in (
        line.partition("==") for line in (ROOT / "constraints.txt").read_text().split() if "==" in line
    )
}
SOURCES = sorted(path for room in ("gns_pyg", "data_gen") for path in (ROOT / room).rglob("*.py"))


def needed() -> set[str]:
    """Every package that the project and its tests bring along, but for those that a pinned one asks for with ==."""
    found, todo = set(), [(canonicalize_name(r.name), frozenset(r.extras)) for r in ASKED]
    seen = set(todo)
    while todo:
        name, extras = todo.pop()
        found.add(name)
        for asked in map(Requirement, requires(name) or ()):
            applies = any(asked.marker is None or asked.marker.evaluate({"extra": e}) for e in ("", *extras))
            one = (canonicalize_name(asked.name), frozenset(asked.extras))
            exact = any(s.operator == "==" for s in asked.specifier)  # torch's CUDA build asks so for its libraries
            if applies and one not in seen and not (exact and one[0] not in PINS):
                seen.add(one)
                todo.append(one)
    return found


def test_every_package_that_comes_along_is_pinned_and_installed_as_pinned():
    wrong = {name: (version(name), PINS.get(name)) for name in needed()}
    wrong = {name: (had, pin) for name, (had, pin) in wrong.items() if pin is None or Version(had).public != str(pin)}
    assert len(needed()) > 60
    assert wrong == {}


def test_the_pins_are_what_the_project_asks_for():
    assert [str(r) for r in ASKED if not r.specifier.contains(PINS[canonicalize_name(r.name)])] == []


def executes(tree: ast.AST) -> list[str]:
    """Calls that can run what a file says."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            found += [name for name in names if name.split(".")[0] in ("pickle", "cloudpickle", "dill", "marshal")]
        if isinstance(node, ast.Call):
            name, keys = ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords}
            if name in ("eval", "exec", "compile", "yaml.load", "yaml.unsafe_load", "os.system", "instantiate"):
                found.append(name)
            if name == "torch.load" and keys.get("weights_only") != "True":
                found.append(name)
            if keys.get("allow_pickle") == "True" or keys.get("shell") == "True":
                found.append(name)
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_code_is_read_from_a_file(path):
    """Hydra's `instantiate` alone builds what a config names: loggers and callbacks of the command line."""
    allowed = ["instantiate", "instantiate"] if path == ROOT / "gns_pyg" / "run.py" else []
    assert executes(ast.parse(path.read_text())) == allowed


def test_the_check_of_the_checks():
    text = (
        "import pickle; eval('1'); torch.load('a'); np.load('a', allow_pickle=True); torch.load('a', weights_only=True)"
    )
    assert sorted(executes(ast.parse(text))) == ["eval", "np.load", "pickle", "torch.load"]


def test_bundles_that_ship_hold_data_only():
    files = [path for path in bundle.SHIPPED.rglob("*") if path.is_file()]
    assert len(files) >= 6
    assert {path.name for path in files} == {"bundle.json", "card.md", "stability.json", "weights.safetensors"}

"""docs/configuration.md, every config key with unit, default and meaning: `python -m gns_pyg.configuration`.

All of it is read from where the keys live: the records that check them (their docstrings and comments) and conf/.
"""

import inspect
import json
import re
import types
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml

from gns_pyg.config import CONF
from gns_pyg.data.datamodule import DataConfig
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.scene.mesh import SHAPES
from gns_pyg.scene.requirements import Requirements, Requires
from gns_pyg.scene.scene import Scene
from gns_pyg.training.config import TrainingConfig

RECORDS: dict[str, type] = {  # groups whose keys are a record's
    "scene": Scene,
    "model": ModelConfig,
    "requires": Requires,
    "data": DataConfig,
    "training": TrainingConfig,
}
UNITS = {  # a key's ending -> unit; the longest that fits counts
    "_kg_m3": "kg/m³",
    "_m_s2": "m/s²",
    "_rad_s": "rad/s",
    "_m_s": "m/s",
    "_per_s": "1/s",
    "_rad": "rad",
    "_pa": "Pa",
    "_hz": "Hz",
    "_radii": "radii",
    "_m": "m",
    "_s": "s",
}
HEAD = """# Configuration

Written by `python -m gns_pyg.configuration` from the records and files that hold the keys. `key=value` on the command
line sets one, `group=choice` takes a file of conf/; `--cfg job` prints what a run would take, `--help` its groups.
SI units throughout: a key that has a unit ends with it. "required" stands for a key without a default.
"""


def configuration_page() -> str:
    """The page, Markdown."""
    lines = [HEAD]
    for path in sorted(Path(CONF).glob("*.yaml"), key=lambda path: (path.stem != "train", path.stem)):
        commands = [line[2:] for line in path.read_text().splitlines() if line.startswith("# python ")]
        lines += [f"## {path.stem}.yaml\n", "```bash", *commands, "```\n"]
        lines += _table(("key", "default", "unit", "meaning"), [_row(*entry) for entry in _commented(path)])
    lines.append("# Groups\n")
    for folder in sorted(path for path in Path(CONF).iterdir() if path.is_dir()):
        lines += _group(folder)
    return "\n".join(lines)


def _group(folder: Path) -> list[str]:
    files = sorted(folder.glob("*.yaml"))
    lines = [f"## {folder.name}\n", f"Choices: {', '.join(path.stem for path in files)}.\n"]
    record = RECORDS.get(folder.name)
    if record is Scene:
        for title, keys in _records(record, folder.name):
            entries = [_row(*key) for key in keys]
            lines += [f"### {_text(title)}\n", *_table(("key", "default", "unit", "meaning"), entries)]
    elif record is not None:
        heads = [path.stem for path in files]
        rows = []
        for key, default, meaning in next(_records(record, folder.name))[1]:
            name = key.removeprefix(f"{folder.name}.")
            chosen = [_shown(_values(path).get(name, default)) for path in files]
            rows.append((f"`{key}`", *chosen, _unit(key), meaning))
        lines += _table(("key", *heads, "unit", "meaning"), rows)
    elif folder.name != "experiment":
        for path in files:
            entries = [_row(f"{folder.name}.{key}", default, meaning) for key, default, meaning in _commented(path)]
            lines += [f"### {folder.name}={path.stem}\n", *_table(("key", "default", "unit", "meaning"), entries)]
    else:
        lines += ["A whole study each; the first lines of a file are the command that runs it.\n"]
    return lines


def _records(record: type, prefix: str) -> Iterator[tuple[str, list[tuple[str, Any, str]]]]:
    """A record and those within it: (title, [(key, default, meaning), ...])."""
    hints, meanings = get_type_hints(record), _meanings(Requirements if record is Requires else record)
    inner, keys = [], []
    for field in fields(record):
        key, within = f"{prefix}.{field.name}", _record_of(hints[field.name])
        if field.name == "shape" and "part" in prefix:
            inner += [(kind, f"{key}", f" with kind: {name}") for name, kind in SHAPES.items()]
        if within is None:
            keys.append((key, _default(field), meanings.get(field.name, "")))
        else:
            many = get_origin(hints[field.name]) is dict
            inner.append((within, f"{key}.<part>" if many else key, ""))
    yield prefix, keys
    for within, where, suffix in inner:
        for title, found in _records(within, where):
            yield title + suffix, found


def _record_of(hint: Any) -> type | None:
    """The record that a field holds, on its own, as a value of a dict, or where it is not None."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType, dict) else (hint,)
    return next((option for option in options if is_dataclass(option) and isinstance(option, type)), None)


def _meanings(record: type) -> dict[str, str]:
    """Field -> what the docstring's section Attributes, or else the comment behind it, says."""
    found = {}
    for line in inspect.getsource(record).splitlines():
        if field := re.fullmatch(r"    (\w+): [^#]*#\s*(.*)", line):
            found[field[1]] = field[2]
    section = (inspect.getdoc(record) or "").partition("Attributes:\n")[2].split("\n\n")[0]
    for names, text in re.findall(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE):
        found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found


def _default(field: Field) -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return "???" if field.default is MISSING else field.default


def _values(path: Path) -> dict[str, Any]:
    """What a group's file sets, with what its defaults list takes from its neighbours."""
    own = yaml.safe_load(path.read_text()) or {}
    for parent in own.pop("defaults", []):
        if parent != "_self_":
            own = _values(path.with_name(f"{parent}.yaml")) | own
    return own


def _commented(path: Path) -> Iterator[tuple[str, Any, str]]:
    """(key, default, comment) of every key of a file, but Hydra's own."""
    parents: list[tuple[int, str]] = []
    for line in path.read_text().splitlines():
        found = re.fullmatch(r"( *)(\w+): *([^#]*?) *(?:# *(.*))?", line)
        if not found:
            continue
        depth, name, value, comment = len(found[1]), found[2], found[3], found[4] or ""
        parents = [parent for parent in parents if parent[0] < depth]
        key = ".".join([parent[1] for parent in parents] + [name])
        if key.split(".")[0] in ("defaults", "hydra"):
            parents.append((depth, name))
        elif name == "_target_":
            yield key, value, "the class that takes these keys"
        elif value:
            yield key, yaml.safe_load(value) if not value.startswith("${") else value, comment
        else:
            parents.append((depth, name))


def _row(key: str, default: Any, meaning: str) -> tuple[str, ...]:
    return f"`{key}`", _shown(default), _unit(key), meaning


def _unit(key: str) -> str:
    return next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")


def _shown(value: Any) -> str:
    if value == "???":
        return "required"
    return f"`{value if isinstance(value, str) and value else json.dumps(value)}`"


def _table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    lines = [heading, ("---",) * len(heading), *rows]
    return [f"| {' | '.join(_text(cell) for cell in line)} |" for line in lines] + [""]


def _text(cell: str) -> str:
    """What Markdown shows as it is: no column ends within it, and `<name>` is HTML nowhere (in code it never is)."""
    parts = cell.replace("|", "\\|").split("`")
    return "`".join(part if index % 2 else part.replace("<", "&lt;") for index, part in enumerate(parts))


if __name__ == "__main__":
    Path("docs/configuration.md").write_text(configuration_page(), encoding="utf-8")

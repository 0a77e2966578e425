"""--help of every command: what it does, its groups, examples that work."""

import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from gns_pyg.config import CONF

ROOT = Path(__file__).parents[2]
COMMANDS = {
    "train": ["train.py"],
    "rollout": ["rollout.py"],
    "evaluate": ["evaluate.py"],
    "generate": ["-m", "data_gen.generate"],
    "export": ["-m", "gns_pyg.export"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_says_what_it_does_and_its_examples_work(name):
    words = [sys.executable, *COMMANDS[name], "--help"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True)
    assert done.stderr == ""
    beginning = f"python {' '.join(COMMANDS[name])} "
    examples = [line.strip() for line in done.stdout.splitlines() if line.strip().startswith(beginning)]
    assert len(examples) >= 3
    for example in examples:
        overrides = shlex.split(example.removeprefix(beginning).split("   ")[0])
        sweeps = "-m" in overrides
        plain = [word for word in overrides if word != "-m" and not word.startswith("hydra.")]
        assert sweeps or not any(word.startswith("case=range") for word in plain)
        first = [word.replace("range(20)", "0").split(",")[0] for word in plain]
        with initialize_config_dir(CONF, version_base="1.3"):
            assert compose(name, first)


def test_help_of_training_lists_every_group_with_its_choices():
    words = [sys.executable, "train.py", "--help"]
    text = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True).stdout
    groups = {path.parent.name for path in Path(CONF).glob("*/*.yaml")}
    lines = dict(line.split(": ", 1) for line in text.splitlines() if ": " in line and not line.startswith(" "))
    assert groups <= set(lines)
    for group in groups:
        choices = {path.stem for path in (Path(CONF) / group).glob("*.yaml")}
        assert choices == set(lines[group].split(", "))
    for page in ("configuration", "tour", "your_own_scene", "launching"):
        assert f"docs/{page}.md" in text
        assert (ROOT / "docs" / f"{page}.md").is_file()


def test_a_reader_who_leaves_gets_no_error():
    line = f"{sys.executable} train.py --help | head -n 1"
    done = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout.startswith("Trains")
    assert done.stderr == ""

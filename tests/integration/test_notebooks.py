"""Every notebook runs from top to bottom."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]


@pytest.mark.filterwarnings("ignore")  # of Jupyter's own packages
@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_runs(path, trained, monkeypatch):
    monkeypatch.setenv("GNS_RUN", str(trained[0]))
    monkeypatch.setenv("GNS_START_S", "1.15")
    NotebookClient(
        nbformat.read(path, as_version=4), timeout=120, resources={"metadata": {"path": str(ROOT)}}
    ).execute()

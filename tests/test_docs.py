"""The docs site: it builds, no link is broken, and every page is in it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))


def test_the_site_builds_without_a_warning(tmp_path):
    """Strict: a broken link or anchor, or a page that the navigation forgets, is an error."""
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    built = {path.parent.name for path in (tmp_path / "site").glob("*/index.html")}
    assert {page.stem for page in PAGES} - {"index"} <= built
    tags = re.compile(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(?:https?:)?//[^\"]*\"")
    loaded = [tag for path in (tmp_path / "site").rglob("*.html") for tag in tags.findall(path.read_text())]
    assert not [tag for tag in loaded if 'rel="canonical"' not in tag]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_page_is_in_the_navigation(page):
    assert page.name in str(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])

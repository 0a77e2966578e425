"""One HTML page that holds a whole report, the 3D player included. Nothing is loaded: it opens from disk."""

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gns_pyg.errors import BundleError
from gns_pyg.evaluation.ensemble import Ensemble
from gns_pyg.evaluation.metrics import CaseResult
from gns_pyg.evaluation.stress import Line
from gns_pyg.files import whole
from gns_pyg.report import sections
from gns_pyg.report.player import ASSETS, player
from gns_pyg.report.verdict import Verdict
from gns_pyg.scene.requirements import Requirements
from gns_pyg.scene.scene import Scene


@dataclass(frozen=True)
class Model:
    """What a page says of the model beside its figures.

    Attributes:
        name: the bundle, as `bundle=...` would name it.
        requires: what it was built of.
        card: what it was trained on and what that cost.
        stability: what stress.py found, None where it was not run.
    """

    name: str
    requires: Requirements
    card: Mapping[str, Any]
    stability: Verdict | None = None


def write_page(
    path: str | Path,
    title: str,
    metrics: Mapping[str, Any],
    figures: Sequence[Path],
    shown: CaseResult,
    scene: Scene,
    model: Model,
    config_yaml: str,
    versions: Mapping[str, str],
    ensemble: Ensemble | None = None,
) -> Path:
    """Writes the report page under a temporary name, then renames it to `path`.

    Args:
        path: the page, e.g. report.html.
        title: its heading.
        metrics: the flat dict of `evaluate_cases`, with `speed/threads` and `speed/device`.
        figures: files of `write_plots`; the PNGs among them are shown.
        shown: the case that the player plays.
        scene: what was simulated.
        model: what simulated it.
        config_yaml: the resolved config of the run.
        versions: program or package -> version.
        ensemble: roll-outs from nearly the same start, where there are some.
    """
    path = Path(path)
    parts = [
        ("DEM and network", player(shown, scene)),
        ("How good it is", sections.errors(metrics, scene)),
        *([] if ensemble is None else [("How certain it is", sections.ensemble(ensemble))]),
        ("Speed and break-even", sections.speed(metrics, model.card.get("cost"), scene)),
        ("Stability", sections.stability(model.stability, model.name)),
        ("Curves", sections.figures(figures)),
        ("What was simulated", sections.pairs(sections.scene_summary(scene))),
        ("What the scene required of the model", sections.requirements(model.requires)),
        ("Configuration", sections.config(config_yaml)),
        ("Versions", sections.pairs(versions)),
    ]
    body = "".join(f"<section><h2>{html.escape(heading)}</h2>{content}</section>" for heading, content in parts)
    style = (ASSETS / "page.css").read_text(encoding="utf-8")
    text = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{style}</style></head>'
        f"<body><h1>{html.escape(title)}</h1>{sections.lead(scene, model.card)}{body}</body></html>\n"
    )
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def read_stability(bundle: Path) -> Verdict | None:
    """The verdict that stress.py gave a bundle: stability.json in its folder or beside it; None if there is none.

    Raises:
        BundleError: if the file is not what stress.py writes.
    """
    file = next((f / "stability.json" for f in (bundle, bundle.parent) if (f / "stability.json").is_file()), None)
    if file is None:
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        form, lines = found["form"], [Line(**row) for row in found["lines"]]
        texts = [form, *(text for line in lines for text in (line.line, line.found))]
        sound = all(isinstance(text, str) for text in texts)
        sound = sound and all(line.hard in (True, False) and line.holds in (True, False, None) for line in lines)
    except (OSError, ValueError, KeyError, TypeError):
        sound = False
    if not sound:
        expected = "what stress.py writes: `form` and `lines`, each with line, hard, holds and found"
        raise BundleError(file, "something else", expected, "run stress.py again, or delete the file")
    return Verdict(form, lines)

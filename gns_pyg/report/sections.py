"""The parts of a page as HTML: what was simulated, what it required, how good, how fast, how stable."""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gns_pyg.card import seen_earlier
from gns_pyg.errors import DataError
from gns_pyg.evaluation.ensemble import SHIFT_M, Ensemble
from gns_pyg.report.cost import break_even
from gns_pyg.report.table import ensemble_rows, metric_rows
from gns_pyg.report.verdict import Verdict, mark
from gns_pyg.scene.requirements import Requirements
from gns_pyg.scene.scene import Motion, Scene

PAPER = {  # its own network on its own scenes: one step at t = 0.1 s; last frame (sections 5.1 and 5.2)
    "hopper": "0.874 mm after one step at 0.1 s, 93.9 mm at 2 s, on its hopper of 2,608 grains",
    "drum": "2.81 mm after one step at 0.1 s, 79.0 mm at 3 s, on its drum of 2,530 grains",
}


def scene_summary(scene: Scene) -> dict[str, str]:
    """What a reader must know of a scene, in human units."""
    material = scene.grains.material
    walls = [
        f"{name}: {part.shape.get('kind', '?')}, {part.points} boundary points{_moving(part.motion)}"
        for name, part in scene.boundary.items()
    ]
    damped = "gravity included" if scene.damping_on_gravity else "gravity excluded"
    summary = {
        "grains": ", ".join(f"{n} of {2e3 * radius_m:g} mm" for radius_m, n in scene.grains.counts) + " diameter",
        "material": f"{material.density_kg_m3:g} kg/m\N{SUPERSCRIPT THREE}, Young's modulus "
        f"{material.young_modulus_pa:.3g} Pa, friction angle {material.friction_angle_rad:g} rad",
        "boundary": "; ".join(walls) or "none",
        "gravity": f"{_vector(scene.gravity_m_s2)} m/s\N{SUPERSCRIPT TWO}",
        "damping": f"{scene.damping:g} ({damped})" if scene.damping else "none",
        "run": f"{scene.duration_s:g} s, a frame every {1e3 * scene.frame_dt_s:g} ms",
    }
    if scene.vary:
        values = (f"{name} ({', '.join(f'{v:g}' for v in of)})" for name, of in scene.vary.items())
        summary["differs from case to case"] = ", ".join(values)
    if (outlet := scene.outlet) is not None:
        summary["outlet"] = f"beyond the plane through {_vector(outlet.point_m)} m, outwards {_vector(outlet.normal)}"
    if (inlet := scene.inlet) is not None:
        speed = f"{_vector(inlet.velocity_m_s)} m/s"
        summary["inlet"] = (
            f"{inlet.count} grains, {inlet.rate_per_s:g} per s, at {_vector(inlet.center_m)} m with {speed}"
        )
    return summary


def lead(scene: Scene, card: Mapping[str, Any]) -> str:
    """What this is about, in two lines."""
    summary = scene_summary(scene)
    text = f"Grains: {summary['grains']}; walls: {summary['boundary']}; {summary['run']}."
    return f"<p>{html.escape(text)}<br>The network was trained on {html.escape(trained_on(card))}.</p>"


def requirements(requires: Requirements) -> str:
    """Every row of what the scene requires, and why."""
    shown = {True: "yes", False: "no"}
    rows = []
    for row, value in asdict(requires).items():
        if row != "reasons":
            text = ", ".join(value) or "no" if isinstance(value, list) else shown.get(value, str(value))
            rows.append((row.replace("_", " "), text, requires.reasons.get(row, "")))
    return table(("the model has", "", "because"), rows)


def errors(metrics: Mapping[str, Any], scene: Scene) -> str:
    """The error table, and the paper's figures where it has such a scene."""
    heading, *rows = metric_rows(metrics)
    kind = next((name for name in PAPER if name in scene.name.split("_")), None)
    other = "" if scene.name == kind else f" {scene.name} is another scene: the figures do not compare."
    paper = f"<p>The paper's network: {PAPER[kind]}.{html.escape(other)}</p>" if kind else ""
    return table(heading, rows) + paper


def speed(metrics: Mapping[str, Any], cost: Mapping[str, Any] | None, scene: Scene) -> str:
    """Wall clock of network and Yade, and when the network has paid for itself."""
    own, yade = (metrics[f"speed/{name}seconds_per_simulated_second"] for name in ("", "yade_"))
    ratio = yade / own
    faster = f"{ratio:.3g} times as fast as Yade" if ratio > 1 else f"slower than Yade: {own / yade:.3g} times its time"
    threads = metrics["speed/threads"]
    rows = [
        ("network, per simulated second", f"{own:.3g} s", f"{metrics['speed/device']}, {threads} thread(s)"),
        (
            "Yade, per simulated second",
            f"{yade:.3g} s",
            f"{metrics['speed/yade_cores']} core(s), dt {1e6 * metrics['speed/yade_dt_s']:.3g} \N{MICRO SIGN}s, "
            "on the machine that made the data",
        ),
        ("the network is", faster, "at the errors in the table above"),
        *((what, value, "") for what, value in break_even(cost, metrics, scene.duration_s)),
    ]
    return table(("", "", ""), rows)


def ensemble(found: Ensemble) -> str:
    """Mean and spread of the members beside DEM."""
    heading, *rows = ensemble_rows(found)
    remark = (
        f"{len(found.error_m)} roll-outs from starts {1e6 * SHIFT_M:g} \N{MICRO SIGN}m apart (standard deviation of "
        "every coordinate): mean and spread over them, in SI units. CRPS, the continuous ranked probability score: 0 "
        "is perfect, and of a single roll-out it is the absolute error. Curves: figure <i>ensemble</i>."
    )
    return f"<p>{remark}</p>{table(heading, rows)}"


def stability(verdict: Verdict | None, bundle: str) -> str:
    """What the stress suite found, or how to run it."""
    if verdict is None:
        return (
            f"<p>not run: <code>python stress.py bundle={html.escape(bundle)}</code>; its stability.json, put into the "
            "bundle's folder, is shown here</p>"
        )
    rows = [(line.line, mark(line), line.found) for line in verdict.lines]
    return f"<p>{html.escape(verdict.form)} form of stress.py</p>{table(('', '', 'found'), rows)}"


def trained_on(card: Mapping[str, Any]) -> str:
    """How many cases a bundle has seen, and for what."""
    counts = {purpose: len(files) for purpose, files in card["cases"].items()}
    answers = f" and {counts['answers']} files of answers" if counts.get("answers") else ""
    others = f"; earlier on {seen_earlier(card)} others" if seen_earlier(card) else ""
    cases = f"{counts['train']} case{'' if counts['train'] == 1 else 's'}{answers}"
    return f"{cases}, {counts['val']} for validation{others}"


def config(text: str) -> str:
    """The resolved config, folded."""
    return f"<details><summary>all keys</summary><pre>{html.escape(text)}</pre></details>"


def figures(files: Sequence[Path]) -> str:
    """The PNGs among `files`.

    Raises:
        DataError: if one cannot be read.
    """
    return f'<div class="figures">{"".join(_figure(file) for file in files if file.suffix == ".png")}</div>'


def table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Three columns: what, value, remark."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heading)
    body = "".join(
        f'<tr><th scope="row">{html.escape(what)}</th><td class="number">{html.escape(own)}</td>'
        f"<td>{html.escape(beside)}</td></tr>"
        for what, own, beside in rows
    )
    thead = f"<thead><tr>{head}</tr></thead>" if any(heading) else ""
    return f"<table>{thead}<tbody>{body}</tbody></table>"


def pairs(rows: Mapping[str, str]) -> str:
    """Two columns."""
    cells = "".join(
        f'<tr><th scope="row">{html.escape(str(what))}</th><td>{html.escape(str(value))}</td></tr>'
        for what, value in rows.items()
    )
    return f"<table><tbody>{cells}</tbody></table>"


def _moving(motion: Motion) -> str:
    if not motion.moves:
        return ""
    verb, unit = ("turning", "rad") if motion.kind == "rotation" else ("moving", "m")
    if motion.kind == "oscillation":
        return f", oscillating by {1e3 * motion.amplitude_m:g} mm at {motion.frequency_hz:g} Hz"
    if motion.function is not None:
        return f", {verb} by {motion.function} {unit}"
    return f", {verb} at {motion.rate_rad_s or motion.speed_m_s:g} {unit}/s"


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _figure(file: Path) -> str:
    try:
        content = base64.b64encode(file.read_bytes()).decode("ascii")
    except OSError as error:
        raise DataError(file, str(error), "a PNG figure", "draw the plots before the page") from error
    name = html.escape(file.stem.replace("_", " "))
    return f'<figure class="{html.escape(file.stem)}"><img alt="{name}" src="data:image/png;base64,{content}"></figure>'

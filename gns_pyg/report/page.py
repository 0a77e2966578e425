"""One HTML page that holds a whole report: figures, figures' numbers, scene, config, versions. Nothing is loaded."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gns_pyg.errors import DataError
from gns_pyg.files import whole
from gns_pyg.report.table import metric_rows
from gns_pyg.scene.scene import Motion, Scene

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; } th, td { padding: .3rem .9rem .3rem 0; text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid #1a1a1a; } tbody tr { border-bottom: 1px solid #ddd; }
td.number { white-space: nowrap; font-variant-numeric: tabular-nums; }
figure { margin: 1.2rem 0; } img { max-width: 100%; height: auto; }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: .85rem; }
"""


def write_page(
    path: str | Path,
    title: str,
    metrics: Mapping[str, Any],
    figures: Sequence[Path],
    scene: Scene,
    config_yaml: str,
    versions: Mapping[str, str],
) -> Path:
    """Writes the report page under a temporary name, then renames it to `path`.

    Args:
        path: the page, e.g. report.html.
        title: its heading.
        metrics: the flat dict of `evaluate_cases`.
        figures: files of `write_plots`; the PNGs among them are shown.
        scene: summarised in a table.
        config_yaml: the resolved config of the run.
        versions: program or package -> version.
    """
    path = Path(path)
    sections = [
        ("How good it is", _metrics(metrics)),
        ("Figures", "".join(_figure(file) for file in figures if file.suffix == ".png")),
        ("Scene", _pairs(scene_summary(scene))),
        ("Config", f"<details><summary>all keys</summary><pre>{html.escape(config_yaml)}</pre></details>"),
        ("Versions", _pairs(versions)),
    ]
    body = "".join(f"<section><h2>{html.escape(heading)}</h2>{content}</section>" for heading, content in sections)
    text = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
        f"<body><h1>{html.escape(title)}</h1>{body}</body></html>\n"
    )
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


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


def _metrics(metrics: Mapping[str, Any]) -> str:
    heading, *rows = metric_rows(metrics)
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heading)
    body = "".join(
        f'<tr><th scope="row">{html.escape(what)}</th><td class="number">{html.escape(own)}</td>'
        f"<td>{html.escape(beside)}</td></tr>"
        for what, own, beside in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _pairs(pairs: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{html.escape(str(what))}</th><td>{html.escape(str(value))}</td></tr>'
        for what, value in pairs.items()
    )
    return f"<table><tbody>{rows}</tbody></table>"


def _figure(file: Path) -> str:
    try:
        content = base64.b64encode(file.read_bytes()).decode("ascii")
    except OSError as error:
        raise DataError(file, str(error), "a PNG figure", "draw the plots before the page") from error
    name = html.escape(file.stem.replace("_", " "))
    return f'<figure><img alt="{name}" src="data:image/png;base64,{content}"></figure>'

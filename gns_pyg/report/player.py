"""The 3D player of a page: one roll-out beside its DEM run, packed small enough to travel in the page.

What the browser does with it is assets/player.js. Positions are whole multiples of a 64th of the smallest radius
(nobody sees less), colours one byte per grain and frame; both as differences from frame to frame, deflated. Where that
is still too large, frames are left out and the player interpolates.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.colors import to_hex

from gns_pyg.evaluation.contacts import contacts_per_grain
from gns_pyg.evaluation.metrics import CaseResult
from gns_pyg.evaluation.observables import finite_difference_velocity
from gns_pyg.report.view import COLOUR_QUANTILE, placed, view
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.motion import way
from gns_pyg.scene.scene import Motion, Scene

ASSETS = Path(__file__).parent / "assets"
BUDGET_BYTES = 11_000_000  # of the packed frames, so that a page stays under 15 MB with figures and three.js
PARTS_OF_RADIUS = 64
BYTES = 17  # of a grain in a frame, before deflating: two positions, five shades
ABSENT, UNKNOWN = 65535, 255  # of a coordinate and of a shade
N_COLOURS = 33


@dataclass(frozen=True)
class Mode:
    """A way to colour grains.

    Attributes:
        label, unit: for people.
        values: one array (n_frames, n_grains) per view, or a single one that both share; nan where not known.
        whole: values are counts.
    """

    label: str
    unit: str
    values: list[np.ndarray]
    whole: bool = False


def player(result: CaseResult, scene: Scene, budget_bytes: int = BUDGET_BYTES) -> str:
    """The player of one case as HTML: controls, data, three.js and script. A page can hold one.

    Args:
        result: the case, from the roll-out's start on.
        scene: its walls, with the frames' distance of `result`.
        budget_bytes: most that the packed frames may take in the page; frames are left out to keep it.
    """
    n_frames, n_grains = result.pos.shape[:2]
    raw = n_frames * n_grains * BYTES
    every = 1 + raw // (8 * budget_bytes)  # a first guess: deflate does not gain more than that
    modes = _modes(result)
    box_m, grid = _grid(result, scene)
    while True:
        kept = np.unique(np.append(np.arange(0, n_frames, every), n_frames - 1))
        packed = _pack(result, modes, grid, kept)
        if len(packed) <= budget_bytes or len(kept) <= 2:
            break
        every = max(every + 1, -(-every * len(packed) // budget_bytes))
    meta = _meta(result, scene, modes, grid, box_m, kept, every)
    data = json.dumps(meta, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    asset = {name: (ASSETS / name).read_text(encoding="utf-8") for name in ("player.html", "three.min.js", "player.js")}
    return (
        f"{asset['player.html']}"
        f'<script type="application/json" id="player-meta">{data}</script>'
        f'<script type="application/octet-stream" id="player-frames">{packed}</script>'
        f"<script>{asset['three.min.js']}</script><script>{asset['player.js']}</script>"
    )


def _modes(result: CaseResult) -> list[Mode]:
    """Speed of the step that leaves a frame (the last frame repeats it), distance from DEM, grains in touch."""
    speeds, contacts = [], []
    for pos in (result.dem_pos, result.pos):
        speed = np.linalg.norm(finite_difference_velocity(pos, result.times_s), axis=2)
        speeds.append(np.concatenate([speed, speed[-1:]]))
        contacts.append(contacts_per_grain(pos, result.radius))
    error_mm = 1e3 * np.linalg.norm(result.dem_pos - result.pos, axis=2)
    return [
        Mode("speed", "m/s", speeds),
        Mode("distance from DEM", "mm", [error_mm]),
        Mode("coordination number", "", contacts, whole=True),
    ]


@dataclass(frozen=True)
class _Grid:
    """Where coordinates are counted from, m (3,), and their unit, m."""

    origin_m: np.ndarray
    unit_m: float


def _grid(result: CaseResult, scene: Scene) -> tuple[np.ndarray, _Grid]:
    """The box (2, 3) m around walls and DEM's grains, and a grid that reaches once its length beyond on every side: a
    grain further out (a roll-out can lose one) is not drawn, so that it does not cost the others their resolution."""
    pos, largest = result.dem_pos, result.radius.max()
    seen = [np.nanmin(pos, axis=(0, 1))[None] - largest, np.nanmax(pos, axis=(0, 1))[None] + largest]
    for name, part in scene.boundary.items():
        mesh = build_mesh(name, part)
        times_s = result.times_s[:: max(1, len(pos) // 12)] if part.motion.moves else result.times_s[:1]
        seen += [placed(mesh, part.motion, float(time_s)) for time_s in times_s]
    points = np.concatenate(seen)
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    reach = np.ptp(box, axis=0).max()
    unit = max(result.radius.min() / PARTS_OF_RADIUS, 3 * reach / (ABSENT - 1))
    return box, _Grid(box[0] - reach, unit)


def _pack(result: CaseResult, modes: list[Mode], grid: _Grid, kept: np.ndarray) -> str:
    """Frames `kept`, deflated and in base64; player.js unpacks in the same order."""
    deflate = zlib.compressobj(6)
    chunks = []
    for pos in (result.dem_pos[kept], result.pos[kept]):
        counted = np.round((pos - grid.origin_m) / grid.unit_m)
        within = ((counted >= 0) & (counted < ABSENT)).all(axis=2, keepdims=True)  # nan is not
        stored = _differences(np.where(within, counted, ABSENT).astype(np.uint16))
        chunks += [
            deflate.compress((stored & 255).astype(np.uint8).tobytes()),
            deflate.compress((stored >> 8).astype(np.uint8).tobytes()),
        ]
    for mode in modes:
        top = _top(mode)
        for values in mode.values:
            shade = np.round(np.clip(values[kept] / top, 0, 1) * (UNKNOWN - 1))
            known = np.where(np.isfinite(shade), shade, UNKNOWN).astype(np.uint8)
            chunks.append(deflate.compress(_differences(known).tobytes()))
    chunks += [deflate.compress(result.radius.astype("<f4").tobytes()), deflate.flush()]
    return base64.b64encode(b"".join(chunks)).decode("ascii")


def _differences(frames: np.ndarray) -> np.ndarray:
    """The first frame, then what each adds to the last, modulo the integer's range; contiguous."""
    return np.concatenate([frames[:1], frames[1:] - frames[:-1]])


def _top(mode: Mode) -> float:
    """Where the colour scale ends."""
    known = np.concatenate([values[np.isfinite(values)] for values in mode.values])
    top = float(np.quantile(known, COLOUR_QUANTILE)) if len(known) else 0.0
    return max(top, 1.0 if mode.whole else 1e-6)


def _meta(
    result: CaseResult, scene: Scene, modes: list[Mode], grid: _Grid, box_m: np.ndarray, kept: np.ndarray, every: int
) -> Mapping[str, Any]:
    up, toward_reader = view(scene)[1:]
    times_s = result.times_s[kept]
    remark = f"{result.name}: {result.pos.shape[1]} grains."
    remark += " Drag to turn, then scroll to come closer; right button to shift. Both views move together."
    if every > 1:
        remark += f" To keep this page small it holds one frame in {every}; between them grains move in straight lines."
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 1, N_COLOURS))
    return {
        "views": ["DEM (Yade)", "network"],
        "grains": result.pos.shape[1],
        "times_s": times_s.round(6).tolist(),
        "origin_m": grid.origin_m.tolist(),
        "unit_m": grid.unit_m,
        "box_m": box_m.tolist(),
        "middle_m": box_m.mean(axis=0).tolist(),
        "size_m": float(np.ptp(box_m, axis=0).max()),
        "up": up.tolist(),
        "toward_reader": toward_reader.tolist(),
        "modes": [
            {
                "label": mode.label,
                "unit": mode.unit,
                "top": _top(mode),
                "open": any((values > _top(mode)).any() for values in mode.values),
                "shared": len(mode.values) == 1,
            }
            for mode in modes
        ],
        "colours": [to_hex(colour) for colour in colours],
        "walls": [_wall(name, scene, times_s) for name in scene.boundary],
        "remark": remark,
    }


def _wall(name: str, scene: Scene, times_s: np.ndarray) -> Mapping[str, Any]:
    """A boundary part in its own frame, and how far (rad or m) it has come at every time."""
    part = scene.boundary[name]
    mesh, motion = build_mesh(name, part), part.motion
    return {
        "vertices": np.round(mesh.vertices, 6).tolist(),
        "triangles": mesh.faces.tolist(),
        "origin_m": list(motion.origin_m),
        "axis": _unit(motion),
        "turns": motion.kind == "rotation",
        "way": way(motion, torch.from_numpy(times_s.copy()))[0].tolist() if motion.moves else [],
    }


def _unit(motion: Motion) -> list[float]:
    if not motion.moves:
        return [0.0, 0.0, 1.0]
    axis = np.asarray(motion.axis, np.float64)
    return (axis / np.linalg.norm(axis)).tolist()

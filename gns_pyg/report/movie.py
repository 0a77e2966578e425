"""A roll-out beside DEM as a small moving picture."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from gns_pyg.evaluation.metrics import CaseEvaluation
from gns_pyg.evaluation.observables import finite_difference_velocity
from gns_pyg.files import whole
from gns_pyg.report.plots import frame_of_view, wall_lines
from gns_pyg.report.view import COLOUR_QUANTILE, view
from gns_pyg.scene.scene import Scene

FRAMES, FRAME_MS = 40, 100


def write_movie(case: CaseEvaluation, scene: Scene, path: Path) -> Path:
    """Writes a GIF: DEM left, network right, in at most FRAMES frames, coloured by speed (see `plots.snapshots`).

    Raises:
        StorageError: if it cannot be written.
    """
    result = case.result
    right, up, depth = view(scene)
    sides = {"DEM": result.dem_pos, "network": result.pos}
    speeds = [np.linalg.norm(finite_difference_velocity(pos, result.times_s), axis=2) for pos in sides.values()]
    known = speeds[0][np.isfinite(speeds[0])]
    scale = Normalize(0.0, max(float(np.quantile(known, COLOUR_QUANTILE)) if len(known) else 0.0, 1e-6))
    (left, low), (edge, high) = frame_of_view(case, scene, right, up)
    tall = float(np.clip((high - low) / (edge - left), 0.5, 2.0))
    figure = Figure((6.4, 3.0 * tall + 0.5), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(1, 2)

    def draw(frame: int) -> Image.Image:
        for axes, (name, pos), speed in zip(grid, sides.items(), speeds, strict=True):
            axes.clear()
            there = np.flatnonzero(np.isfinite(speed[frame]))
            order = there[np.argsort(pos[frame, there] @ depth)]
            points = np.stack([pos[frame][order] @ right, pos[frame][order] @ up], axis=1)
            size = 2 * result.radius[order]
            grains = EllipseCollection(size, size, 0.0, units="xy", offsets=points, offset_transform=axes.transData)
            grains.set(array=speed[frame][order], norm=scale, cmap="viridis", edgecolor="0.15", linewidth=0.15)
            axes.add_collection(grains)
            axes.add_collection(wall_lines(scene, float(result.times_s[frame]), right, up, depth))
            axes.set(xlim=(left, edge), ylim=(low, high), aspect="equal", xticks=[], yticks=[], title=name)
            axes.spines[:].set_visible(False)
        figure.suptitle(f"{scene.name}, {result.name}: t = {result.times_s[frame]:.2f} s", fontsize=10)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

    last = len(result.times_s) - 2
    first, *others = [draw(frame) for frame in np.unique(np.linspace(0, last, FRAMES).round().astype(int)).tolist()]
    with whole(path) as temporary:
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=FRAME_MS, loop=0)
    return path

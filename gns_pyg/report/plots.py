"""Figures of an evaluation, each as PNG and SVG. Colours are Okabe and Ito's, which colour-blind readers tell apart;
DEM, network and climatology also differ by line style, so that a print in black and white reads too."""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from trimesh import Trimesh

from gns_pyg.evaluation.ensemble import Ensemble
from gns_pyg.evaluation.errors import mean_present, present
from gns_pyg.evaluation.metrics import CaseEvaluation, CaseResult, Evaluation, Observables
from gns_pyg.evaluation.observables import finite_difference_velocity
from gns_pyg.files import whole
from gns_pyg.report.view import COLOUR_QUANTILE, placed, view
from gns_pyg.scene.mesh import build_mesh
from gns_pyg.scene.scene import Scene
from gns_pyg.scene.symmetry import up_direction

Style = Literal["-", "--", ":"]

BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
CASE_COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DEM: Style = "-"
NETWORK: Style = "--"
SPEED_BINS = 40
CLIMATOLOGY: Style = ":"
PAPER_FINAL_ERROR_MM = {"hopper": 93.9, "drum": 79.0}  # sections 5.1: hopper at 2 s, drum at 3 s


def write_plots(evaluation: Evaluation, scene: Scene, folder: str | Path) -> list[Path]:
    """Writes every figure of `draw` into `folder`; returns the files, per figure PNG then SVG."""
    drawn = draw(evaluation, scene)
    return [file for name, figure in drawn.items() for file in write_figure(figure, Path(folder) / name)]


def write_figure(figure: Figure, path: Path) -> list[Path]:
    """Writes a figure as `path`.png and `path`.svg; returns both."""
    files = [path.with_name(f"{path.name}.{ending}") for ending in ("png", "svg")]
    for file in files:
        with whole(file) as temporary:
            figure.savefig(temporary, format=file.suffix[1:], dpi=150)
    return files


def write_picture(figure: Figure, file: Path, dpi: int) -> None:
    """Writes a figure for the repository: a PNG of at most 256 colours, a third of the size of one of all colours."""
    with whole(file) as temporary, BytesIO() as drawn:
        figure.savefig(drawn, format="png", dpi=dpi)
        Image.open(drawn).convert("RGB").quantize(dither=Image.Dither.NONE).save(temporary, format="png", optimize=True)


def draw(evaluation: Evaluation, scene: Scene) -> dict[str, Figure]:
    """Draws every figure that the evaluation has data for, by name."""
    figures = {
        "rollout_error": rollout_error(evaluation, scene),
        "one_step_error": one_step_error(evaluation, scene),
        "center_of_mass": center_of_mass_height(evaluation, scene),
        "overlap": overlap(evaluation, scene),
        "mean_speed": mean_speed(evaluation, scene),
        "granular_temperature": granular_temperature(evaluation, scene),
        "speed_distribution": speed_distribution(evaluation, scene),
    }
    if scene.angle_of_repose is not None:
        figures["angle_of_repose"] = angle_of_repose(evaluation, scene)
    if scene.outlet is not None:
        figures["outflow"] = outflow(evaluation, scene)
    if scene.mouth_height_m is not None:
        figures["discharge"] = discharge(evaluation, scene)
    return figures | {"snapshots": snapshots(evaluation.cases[0], scene)}


def rollout_error(evaluation: Evaluation, scene: Scene) -> Figure:
    """Position error of the roll-out against time: every case thin, their mean bold, beside frozen grains."""
    figure, axes = _figure(f"{scene.name}: position error of the roll-out", "mean distance from DEM (mm)")
    for case in evaluation.cases:
        axes.plot(case.result.times_s, 1e3 * case.error_m, color=BLUE, linewidth=0.7, alpha=0.6)
    axes.plot(*_mean_curve(evaluation, lambda case: case.error_m, 1e3), color=BLUE, linewidth=2.2, label="network")
    frozen = _mean_curve(evaluation, lambda case: case.frozen_error_m, 1e3)
    axes.plot(*frozen, color=ORANGE, linewidth=1.6, linestyle="-.", label="frozen at the start")
    label: str | None = "DEM twins, a micrometre apart"
    for result in (case.result for case in evaluation.cases):
        if result.twins is not None:
            mean, std = 1e3 * result.twins.mean_m, 1e3 * result.twins.std_m
            axes.fill_between(result.times_s, mean - std, mean + std, color=GREEN, alpha=0.25, linewidth=0)
            axes.plot(result.times_s, mean, color=GREEN, linewidth=1.2, linestyle="--", label=label)
            label = None  # once in the legend
    if scene.name in PAPER_FINAL_ERROR_MM:
        final = PAPER_FINAL_ERROR_MM[scene.name]
        axes.axhline(final, color="0.35", linestyle=":", label=f"paper's network at the end: {final:g} mm")
    n_cases = len(evaluation.cases)
    return _finish(figure, axes, note=f"mean of {n_cases} test cases bold, each case thin" if n_cases > 1 else "")


def one_step_error(evaluation: Evaluation, scene: Scene) -> Figure:
    """One-step position error along the runs, beside the best trivial predictor."""
    figure, axes = _figure(f"{scene.name}: one-step position error", "mean distance from DEM (mm)")
    for case in evaluation.cases:
        times_s = case.result.one_step_times_s
        axes.plot(times_s, 1e3 * case.result.one_step_error_m, color=BLUE, linewidth=0.7, alpha=0.5)
    common = min((case.result.one_step_times_s for case in evaluation.cases), key=len)
    own = [case.result.one_step_error_m[: len(common)] for case in evaluation.cases]
    trivial = [case.result.trivial_error_m[evaluation.trivial_name][: len(common)] for case in evaluation.cases]
    axes.plot(common, 1e3 * mean_present(np.array(own), axis=0), color=BLUE, linewidth=2.2, label="network")
    label = f"best trivial predictor: {evaluation.trivial_name}"
    beside = 1e3 * mean_present(np.array(trivial), axis=0)
    axes.plot(common, beside, color=VERMILION, linewidth=1.6, linestyle="-.", label=label)
    frame_ms = 1e3 * scene.frame_dt_s
    return _finish(figure, axes, note=f"one step is {frame_ms:g} ms, always from DEM's own state")


def center_of_mass_height(evaluation: Evaluation, scene: Scene) -> Figure:
    """Height of the centre of mass against time, every test case."""
    up = up_direction(scene)
    figure, axes = _figure(f"{scene.name}: height of the centre of mass", "height (mm)")
    _compare(axes, evaluation, lambda observed: 1e3 * observed.center_of_mass_m @ up)
    times_s = _longest(evaluation)
    climatology = evaluation.climatology.center_of_mass_at(times_s) @ up
    axes.plot(times_s, 1e3 * climatology, color="black", linestyle=CLIMATOLOGY, linewidth=1.8)
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=True))


def angle_of_repose(evaluation: Evaluation, scene: Scene) -> Figure:
    """Angle of repose against time, every test case; the averaged part is shaded."""
    figure, axes = _figure(f"{scene.name}: angle of repose", "angle of the free surface (degrees)")
    half = round(0.05 / scene.frame_dt_s)  # a single frame's angle scatters by several degrees

    def angle(observed: Observables) -> np.ndarray:
        angle_deg = observed.angle_of_repose_deg
        return np.zeros(0) if angle_deg is None else _running_mean(angle_deg, half)

    _compare(axes, evaluation, angle)
    times_s, known = _longest(evaluation), evaluation.climatology
    if known.angle_of_repose_deg is not None:
        climatology = np.interp(times_s, known.times_s, _running_mean(known.angle_of_repose_deg, half))
        axes.plot(times_s, climatology, color="black", linestyle=CLIMATOLOGY, linewidth=1.8)
    note = f"running mean over {(2 * half + 1) * scene.frame_dt_s:.2g} s"
    if scene.angle_of_repose is not None and scene.angle_of_repose.from_s < times_s[-1]:
        start_s = max(scene.angle_of_repose.from_s, times_s[0])
        if scene.angle_of_repose.kind == "radial":  # an angle from before the heap has formed means nothing
            steady = np.concatenate([np.asarray(x.get_ydata())[x.get_xdata() >= start_s] for x in axes.get_lines()])
            if np.isfinite(steady).any():
                axes.set_ylim(min(np.nanmin(steady) - 15, 0.0), np.nanmax(steady) + 15)
        axes.axvspan(start_s, times_s[-1], color="0.92", zorder=0)
        note += "; the angle of repose is averaged over the shaded part"
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=True), note=note)


def outflow(evaluation: Evaluation, scene: Scene) -> Figure:
    """Part of the grains that have left against time, every test case."""
    figure, axes = _figure(f"{scene.name}: outflow", "grains that have left (%)")
    _compare(axes, evaluation, lambda observed: np.zeros(0) if observed.outflow is None else 100 * observed.outflow)
    times_s = _longest(evaluation)
    climatology = 100 * evaluation.climatology.outflow_at(times_s)
    axes.plot(times_s, climatology, color="black", linestyle=CLIMATOLOGY, linewidth=1.8)
    note = "of those there at the roll-out's start"
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=True), note=note)


def discharge(evaluation: Evaluation, scene: Scene) -> Figure:
    """Part of the mass that has passed the mouth against time, every test case."""
    figure, axes = _figure(f"{scene.name}: discharge", "mass that has passed the mouth (%)")
    _compare(
        axes, evaluation, lambda observed: np.zeros(0) if observed.discharged is None else 100 * observed.discharged
    )
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=False))


def overlap(evaluation: Evaluation, scene: Scene) -> Figure:
    """Mean overlap of touching pairs against time, every test case."""
    figure, axes = _figure(f"{scene.name}: overlap of touching grains", "mean overlap (% of a diameter)")
    _compare(axes, evaluation, lambda observed: 100 * observed.overlap_ratio)
    if any((case.model.overlap_ratio > 0).any() for case in evaluation.cases):
        axes.set_yscale("log")
    return _finish(
        figure, axes, handles=_style_handles(evaluation, climatology=False), note="the first frame is DEM's own"
    )


def mean_speed(evaluation: Evaluation, scene: Scene) -> Figure:
    """Mean finite-difference speed against time, every test case."""
    figure, axes = _figure(f"{scene.name}: mean speed of the grains", "mean speed (m/s)")
    _compare(axes, evaluation, lambda observed: observed.mean_speed_m_s)
    note = "displacement over one frame, in DEM as in the network"
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=False), note=note)


def speed_distribution(evaluation: Evaluation, scene: Scene) -> Figure:
    """How often grains have which speed, over all cases and the frames of the roll-outs."""
    figure, axes = _figure(f"{scene.name}: speed distribution", "probability density (s/m)", xlabel="speed (m/s)")
    speeds = {
        name: np.concatenate([_speeds(case.result, of).ravel() for case in evaluation.cases])
        for name, of in (("DEM", "dem_pos"), ("network", "pos"))
    }
    known = {name: values[np.isfinite(values)] for name, values in speeds.items()}
    fastest = max((values.max() for values in known.values() if len(values)), default=0.0)
    edges = np.linspace(0.0, max(fastest, 1e-6), SPEED_BINS + 1)
    for (name, values), color, style in zip(known.items(), ("black", VERMILION), (DEM, NETWORK), strict=True):
        density = np.histogram(values, edges)[0] / max(len(values), 1) / np.diff(edges)
        axes.stairs(
            np.where(density > 0, density, np.nan), edges, color=color, linestyle=style, linewidth=1.6, label=name
        )
    axes.set_yscale("log")
    return _finish(figure, axes, note="displacement over one frame, all grains, frames and cases")


def granular_temperature(evaluation: Evaluation, scene: Scene) -> Figure:
    """Granular temperature against time, every test case: what a network that smooths collisions loses."""
    unit = "m\N{SUPERSCRIPT TWO}/s\N{SUPERSCRIPT TWO}"
    figure, axes = _figure(f"{scene.name}: granular temperature", f"granular temperature ({unit})")
    _compare(axes, evaluation, lambda observed: observed.granular_temperature_m2_s2)
    if any((case.dem.granular_temperature_m2_s2 > 0).any() for case in evaluation.cases):
        axes.set_yscale("log")
    note = "velocity fluctuation against neighbours within three radii"
    return _finish(figure, axes, handles=_style_handles(evaluation, climatology=False), note=note)


def snapshots(case: CaseEvaluation, scene: Scene, n_times: int = 4) -> Figure:
    """DEM above network at `n_times` times of one case, grains in their true size coloured by speed.

    Speed is the displacement to the next frame over the time between, in both rows; a grain that is not in both
    frames is not drawn. The view is along the axis of a turning or plane scene, across the way of another moving part,
    else along a horizontal axis.
    """
    result = case.result
    frames = np.unique(np.linspace(0, len(result.times_s) - 2, n_times).round().astype(int))
    right, up, depth = view(scene)
    rows = {"DEM": result.dem_pos, "network": result.pos}
    speeds = {
        name: np.linalg.norm(finite_difference_velocity(pos, result.times_s)[frames], axis=2)
        for name, pos in rows.items()
    }
    known = np.concatenate([speed[np.isfinite(speed)] for speed in speeds.values()])
    fast = float(np.quantile(known, COLOUR_QUANTILE)) if len(known) else 0.0
    scale = Normalize(0.0, max(fast, 1e-6))
    (left, low), (edge, high) = frame_of_view(case, scene, right, up)
    width = 2.3
    size = (width * len(frames) + 1.0, 2 * width * float(np.clip((high - low) / (edge - left), 0.5, 2.0)) + 0.9)
    figure = _bare_figure(size, "compressed")
    grid = figure.subplots(2, len(frames), squeeze=False, sharex=True, sharey=True)
    diameters = 2 * result.radius
    for row, (name, pos) in zip(grid, rows.items(), strict=True):
        for axes, frame, speed in zip(row, frames, speeds[name], strict=True):
            drawn = np.flatnonzero(np.isfinite(speed))
            order = drawn[np.argsort(pos[frame, drawn] @ depth)]
            points = np.stack([pos[frame][order] @ right, pos[frame][order] @ up], axis=1)
            grains = EllipseCollection(
                diameters[order], diameters[order], 0.0, units="xy", offsets=points, offset_transform=axes.transData
            )
            grains.set(array=speed[order], norm=scale, cmap="viridis", edgecolor="0.15", linewidth=0.15)
            grains.set_rasterized(True)  # thousands of circles would make an SVG of many megabytes
            axes.add_collection(grains)
            axes.add_collection(wall_lines(scene, float(result.times_s[frame]), right, up, depth))
            axes.set(xlim=(left, edge), ylim=(low, high), aspect="equal", xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        row[0].set_ylabel(name, fontsize=11)
    for axes, frame in zip(grid[0], frames, strict=True):
        axes.set_title(f"t = {result.times_s[frame]:.2f} s", fontsize=10)
    figure.colorbar(grains, ax=grid, label="speed (m/s)", shrink=0.7, extend="max", pad=0.02)
    figure.suptitle(f"{scene.name}, test case {result.name}: DEM and network from the same start", fontsize=11)
    return figure


def ensemble_spread(ensemble: Ensemble, title: str) -> Figure:
    """Every observable of an ensemble against time: mean and spread of the members, and DEM's own."""
    n_columns = 3
    n_rows = -(-len(ensemble.members) // n_columns)
    figure = _bare_figure((3.6 * n_columns, 2.5 * n_rows))
    grid = list(figure.subplots(n_rows, n_columns, squeeze=False, sharex=True).flat)
    for axes, (name, members) in zip(grid, ensemble.members.items(), strict=False):
        mean, std = members.mean(axis=0), members.std(axis=0, ddof=1)
        axes.fill_between(ensemble.times_s, mean - 2 * std, mean + 2 * std, color=BLUE, alpha=0.25, linewidth=0)
        axes.plot(ensemble.times_s, mean, color=BLUE, linestyle=NETWORK, linewidth=1.4, label="network, mean +- 2 std")
        axes.plot(ensemble.times_s, ensemble.dem[name], color="black", linestyle=DEM, linewidth=1.0, label="DEM")
        axes.set_title(name, fontsize=9)
        axes.grid(color="0.88", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[len(ensemble.members) :]:
        axes.set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.supxlabel("time (s)", fontsize=10)
    figure.suptitle(title, fontsize=11)
    return figure


# --------------------------------------------------------------------------------------------------- building blocks


def _bare_figure(size: tuple[float, float], layout: Literal["constrained", "compressed"] = "constrained") -> Figure:
    """A figure outside pyplot: nothing global, nothing to close."""
    figure = Figure(figsize=size, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _figure(title: str, ylabel: str, xlabel: str = "time (s)") -> tuple[Figure, Axes]:
    figure = _bare_figure((6.4, 4.0))
    axes = figure.subplots()
    axes.set_title(title, fontsize=11)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(color="0.88", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _finish(figure: Figure, axes: Axes, handles: list[Line2D] | None = None, note: str = "") -> Figure:
    if axes.get_yscale() == "linear" and axes.dataLim.ymin >= 0:
        axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)
    shown: Sequence[Artist] = axes.get_legend_handles_labels()[0] if handles is None else handles
    axes.legend(
        handles=shown,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.14),
        ncols=2,
        frameon=False,
        fontsize=9,
        title=note or None,
        title_fontsize=8,
        alignment="left",
    )
    return figure


def _compare(axes: Axes, evaluation: Evaluation, of: Callable[[Observables], np.ndarray]) -> None:
    """Draws one curve of every case: DEM solid, network dashed, a colour per case."""
    for index, case in enumerate(evaluation.cases):
        color, times_s = CASE_COLORS[index % len(CASE_COLORS)], case.result.times_s
        for observed, style, width in ((case.dem, DEM, 1.2), (case.model, NETWORK, 1.6)):
            curve = of(observed)  # a curve of steps is one frame shorter
            axes.plot(times_s[: len(curve)], curve, color=color, linestyle=style, linewidth=width)


def _style_handles(evaluation: Evaluation, climatology: bool) -> list[Line2D]:
    styles: dict[str, Style] = {"DEM": DEM, "network": NETWORK}
    if climatology:
        styles["mean of training cases"] = CLIMATOLOGY
    handles = [Line2D([], [], color="black", linestyle=style, label=name) for name, style in styles.items()]
    if len(evaluation.cases) <= len(CASE_COLORS):
        for color, case in zip(CASE_COLORS, evaluation.cases, strict=False):
            handles.append(Line2D([], [], color=color, linewidth=4, label=case.result.name))
    return handles


def _mean_curve(
    evaluation: Evaluation, of: Callable[[CaseEvaluation], np.ndarray], factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times and mean over cases, as far as all of them reach."""
    shortest = min((case.result.times_s for case in evaluation.cases), key=len)
    return shortest, factor * mean_present(np.array([of(case)[: len(shortest)] for case in evaluation.cases]), axis=0)


def _running_mean(values: np.ndarray, half: int) -> np.ndarray:
    """Mean of the finite values among each one's `half` neighbours on either side; nan where there are none."""
    window = np.ones(2 * half + 1)
    known = np.isfinite(values)
    total = np.convolve(np.where(known, values, 0.0), window)[half : half + len(values)]
    count = np.convolve(known.astype(float), window)[half : half + len(values)]
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def _speeds(result: CaseResult, of: str) -> np.ndarray:
    """Finite-difference speeds (n_frames - 1, n_grains), m/s, nan where a grain is absent."""
    return np.linalg.norm(finite_difference_velocity(getattr(result, of), result.times_s), axis=2)


def _longest(evaluation: Evaluation) -> np.ndarray:
    return max((case.result.times_s for case in evaluation.cases), key=len)


def frame_of_view(case: CaseEvaluation, scene: Scene, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Corners (2, 2) of the view, with a margin: every place of the boundary, and DEM's grains where it does not hold
    them in."""
    pos, times_s = case.result.dem_pos, case.result.times_s
    meshes = {name: build_mesh(name, part) for name, part in scene.boundary.items()}
    holds = bool(meshes) and all(mesh.is_watertight for mesh in meshes.values())
    seen = [] if holds else [pos[present(pos)]]
    for name, mesh in meshes.items():
        motion = scene.boundary[name].motion
        turn_s = np.linspace(0, 2 * np.pi / abs(motion.rate_rad_s), 13) if motion.rate_rad_s else times_s
        seen += [placed(mesh, motion, float(time_s)) for time_s in (turn_s if motion.moves else [0.0])]
    points = np.concatenate(seen) @ np.stack([right, up], axis=1)
    margin = 0.04 * np.ptp(points, axis=0).max() + scene.grains.radii_m[-1] * (not holds)
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def wall_lines(scene: Scene, time_s: float, right: np.ndarray, up: np.ndarray, depth: np.ndarray) -> LineCollection:
    """Silhouette of every boundary part as it stands at `time_s`."""
    lines = []
    for name, part in scene.boundary.items():
        mesh = build_mesh(name, part)
        moved = placed(mesh, part.motion, time_s)
        edges = _silhouette(Trimesh(moved, mesh.faces, process=False), depth)
        lines.append(moved[edges] @ np.stack([right, up], axis=1))
    return LineCollection([edge for part_lines in lines for edge in part_lines], colors="0.3", linewidths=0.8)


def _silhouette(mesh: Trimesh, depth: np.ndarray) -> np.ndarray:
    """Edges (n, 2) between a triangle that faces the reader and one that does not, and open edges."""
    faces_reader = mesh.face_normals @ depth > 1e-9
    turns = faces_reader[mesh.face_adjacency[:, 0]] != faces_reader[mesh.face_adjacency[:, 1]]
    edges, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    return np.concatenate([mesh.face_adjacency_edges[turns], edges[counts == 1]])

"""How far apart do two DEM runs drift that differ by a micrometre? `python -m data_gen.twins scene=hopper_small`.

Goes on with the DEM from a stored frame to the case's end, once from the frame as it is and once per pair with every
grain's position shifted at random, and writes the mean distance between corresponding grains. A roll-out that behaves
like DEM lies at that distance from it. It is no floor: the mean of all that may happen, smooth and wrong, lies nearer.
Config: conf/twins.yaml.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from data_gen.continuation import continue_dem, frame_at, layout, open_case, stored_state
from gns_pyg.config import require
from gns_pyg.evaluation.errors import nanmax, position_error, positions
from gns_pyg.evaluation.metrics import write_json
from gns_pyg.evaluation.observables import center_of_mass, mean_angle_of_repose
from gns_pyg.evaluation.twins import twins_path
from gns_pyg.launch import launch
from gns_pyg.scene.scene import Scene

log = logging.getLogger(__name__)

LARGEST = 1e-3  # of the radius: a larger shift changes the contact forces, a settled bed would jump
SHOWN = 8  # columns of the printed table


def twins(cfg: DictConfig) -> dict[str, Any]:
    """Runs the pairs that `cfg` describes; prints their distance and writes it beside the case, where evaluation
    finds it (twins_006.json for case_006.h5), or into `cfg.folder`.

    Returns:
        `times_s` (n,); `distance_m` (pairs, n), its mean and (sample) standard deviation over pairs (n,);
        `stored_distance_m` (n,): of the run from the unshifted frame from the stored run, which kept what the stored
        frame lacks (contact history, digits). Distances are means over grains, m. `center_of_mass_max_m` (pairs,):
        largest distance of the twins' centres of mass at any frame; `angle_of_repose_deg` (pairs,): difference of
        their steady angles of repose, nan in a scene that has none.

    Raises:
        GnsError: for a case or time that does not exist, a shift out of range, Yade missing or failing.
    """
    trajectory, scene = open_case(cfg)
    frame = frame_at(trajectory, cfg.start_s, "start_s")
    radius, sigma = scene.grains.radii_m[0], cfg.perturbation_m
    require(isinstance(cfg.pairs, int) and cfg.pairs >= 1, "pairs", cfg.pairs, "at least 1", "e.g. pairs=3")
    require(
        isinstance(sigma, float) and 0 < sigma <= LARGEST * radius,
        "perturbation_m",
        sigma,
        f"above 0 and at most {LARGEST * radius:g} m, a thousandth of the radius",
        "use micrometres: a larger shift presses grains together and throws the bed up",
    )
    start, n_frames = stored_state(trajectory, frame), trajectory.n_frames - frame
    base = continue_dem(trajectory, scene, start, n_frames)
    times_s = trajectory.times_s[frame:]
    center, angle = center_of_mass(base, trajectory.mass), steady_angle(base, times_s, scene)
    curves, centers, angles = [], [], []
    for pair in range(cfg.pairs):
        generator = np.random.default_rng((scene.seed, cfg.case, pair))
        shifted = replace(start, pos=start.pos + generator.normal(0.0, sigma, start.pos.shape))
        pos = continue_dem(trajectory, scene, shifted, n_frames)
        curves.append(position_error(pos, base))
        centers.append(nanmax(np.linalg.norm(center_of_mass(pos, trajectory.mass) - center, axis=1)))
        angles.append(abs(steady_angle(pos, times_s, scene) - angle))
        log.info("pair %d of %d: %.4g mm apart at the end", pair + 1, cfg.pairs, 1e3 * curves[-1][-1])
    distance = np.array(curves)
    result = {
        "scene": scene.name,
        "case": trajectory.path.stem,
        "content_hash": trajectory.content_hash(),
        "start_s": float(trajectory.times_s[frame]),
        "perturbation_m": sigma,
        "times_s": times_s,
        "distance_m": distance,
        "mean_distance_m": distance.mean(axis=0),
        "std_distance_m": distance.std(axis=0, ddof=1) if len(distance) > 1 else np.full(n_frames, np.nan),
        "stored_distance_m": position_error(base, positions(trajectory, frame)),
        "center_of_mass_max_m": np.array(centers),
        "angle_of_repose_deg": np.array(angles),
    }
    path = twins_path(trajectory.path)
    write_json(path if cfg.folder is None else Path(cfg.folder) / path.name, result)
    log.info("%s\n%s", trajectory.path, table(result))
    return result


def steady_angle(pos: np.ndarray, times_s: np.ndarray, scene: Scene) -> float:
    """`mean_angle_of_repose`, degrees; nan in a scene that has none."""
    return float("nan") if scene.angle_of_repose is None else mean_angle_of_repose(pos, times_s, scene)[0]


def table(result: dict[str, Any]) -> str:
    """The curves at a few times, mm."""
    shown = np.unique(np.linspace(0, len(result["times_s"]) - 1, SHOWN).round().astype(int))
    heading = ["mean distance, mm, at t =", *(f"{time_s:.3g} s" for time_s in result["times_s"][shown])]
    labels = {"mean_distance_m": "twins, mean", "std_distance_m": "twins, std", "stored_distance_m": "stored run"}
    return layout(heading, [(label, result[key][shown]) for key, label in labels.items()])


if __name__ == "__main__":
    launch("twins", twins)

"""`make results`: judges the bundles that ship with the project and writes docs/results.json, docs/results.md, its
pictures and the bundles' cards. Nothing in them is typed by hand."""

import json
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gns_pyg import bundle, machine
from gns_pyg.card import FILE as CARD
from gns_pyg.card import card_page, seen_earlier
from gns_pyg.data.coverage import seen
from gns_pyg.data.datamodule import find_cases, open_condition, open_to_compare
from gns_pyg.data.trajectory import Trajectory
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import DataError
from gns_pyg.evaluation.baselines import Climatology, of_material
from gns_pyg.evaluation.ensemble import curves, roll_out_ensemble
from gns_pyg.evaluation.errors import nanmean, positions
from gns_pyg.evaluation.judge import judge
from gns_pyg.evaluation.metrics import Evaluation, observe, strict, write_json
from gns_pyg.evaluation.observables import angle_of_repose, escaped_grains, from_frame, mean_speed, time_mean
from gns_pyg.evaluation.predict import roll_out, start_frame
from gns_pyg.report.plots import draw, ensemble_spread, write_picture
from gns_pyg.report.results_page import results_page
from gns_pyg.scene.scene import Scene

BUNDLES = {  # what ships -> conditions it was never trained on
    "hopper": ("hopper_small_fuller", "hopper_small_steeper", "hopper_small_smoother"),
    "drum": ("drum_small_fuller", "drum_small_faster", "drum_small_smoother"),
    "inclined_drum": (),
    "hopper_full": ("hopper_fuller", "hopper_steeper", "hopper_smoother"),
    "drum_full": ("drum_fuller", "drum_faster", "drum_smoother"),
}
REDUCED = ("hopper", "drum", "inclined_drum")  # the embedded data suffice
DOCS = Path(__file__).parents[1] / "docs"
START_S, COMPARE_S = 0.1, 0.01
MEMBERS = 16
PICTURES = (
    "one_step_error",
    "rollout_error",
    "center_of_mass",
    "angle_of_repose",
    "mean_speed",
    "granular_temperature",
    "overlap",
    "snapshots",
)
log = logging.getLogger(__name__)


def results(docs: Path, names: Sequence[str] = REDUCED) -> dict[str, Any]:
    """Judges shipped bundles on the cases that they have not seen, on long runs and on held-out conditions: folders of
    $GNS_DATA (or data/) or of the embedded data.

    Args:
        docs: folder of results.json, results.md and figures/.
        names: the bundles; what results.json says of others stays.

    Returns:
        Scene name -> its `metrics` (the mean over unseen cases), `spread` (their standard deviation), `cases`,
        `seed_scatter` of DEM, `ensemble`, `long` and `held_out`; what is written to results.json.
    """
    path = docs / "results.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    for name in names:
        conditions = BUNDLES[name]
        simulator, card = bundle.load(name), bundle.card(name)
        scene, expected = simulator.scene, Climatology.from_plain(card["climatology"])
        own = own_cases(scene)
        unseen = kept_for_testing(own, scene, card)
        log.info("%s: %d unseen cases", name, len(unseen))
        evaluation = judge(simulator, unseen, expected, START_S)
        pictures(evaluation, replace(scene, frame_dt_s=unseen[0].frame_dt_s), docs / "figures", name)
        found[scene.name] = {
            "bundle": name,
            "metrics": evaluation.metrics | {"speed/device": machine.processor()},
            "spread": spread(evaluation.per_case),
            "cases": evaluation.per_case,
            "trained_on": len(card["cases"]["train"]) + seen_earlier(card),
            "seed_scatter": seed_scatter(of_material(own, scene), scene),
            "ensemble": ensemble_of(name, simulator, unseen[0], docs / "figures"),
            "long": long_runs(name, scene),
            "held_out": {condition: held_out(name, condition, expected) for condition in conditions},
        }
        write_json(path, found)
    write_pages(docs, strict(found))
    return found


def ensemble_of(name: str, simulator: Simulator, case: Trajectory, folder: Path) -> dict[str, Any]:
    """What an ensemble says of a case, without the curves of its observables; draws them."""
    ensemble = roll_out_ensemble(simulator, case, start_frame(case, START_S), MEMBERS)
    title = f"{simulator.scene.name}, {case.path.stem}: {MEMBERS} roll-outs a micrometre apart"
    write_picture(ensemble_spread(ensemble, title), folder / f"results_{name}_ensemble.png", dpi=110)
    return {key: value for key, value in ensemble.plain().items() if key != "observables"}


def own_cases(scene: Scene) -> list[Trajectory]:
    paths = find_cases(scene, None)
    return [open_to_compare(path, scene, max(COMPARE_S, Trajectory(path).frame_dt_s)) for path in paths]


def kept_for_testing(cases: Sequence[Trajectory], scene: Scene, card: Mapping[str, Any]) -> list[Trajectory]:
    """The cases that a bundle kept for testing. They may be recorded at other frames here than where it was trained,
    so they are those that it has not seen, neither their content nor their first frame.

    Raises:
        DataError: if these are others than its card names: figures of other data must not stand in their place.
    """
    unseen = [case for case in cases if not seen(case, scene, card)]
    names, expected = [case.path.name for case in unseen], sorted(card["cases"]["test"])
    if names != expected:
        found, remedy = f"unseen cases {names}", "fetch the data that the bundle was trained beside"
        raise DataError(f"cases of {scene.name}", found, f"those that the bundle kept: {expected}", remedy)
    return unseen


def write_pages(docs: Path, found: Mapping[str, Any]) -> None:
    """Writes what people read of the figures: results.md, and beside every judged bundle that ships its card."""
    (docs / "results.md").write_text(results_page(found), encoding="utf-8")
    for values in found.values():
        page = card_page(bundle.describe(values["bundle"]), values["metrics"])
        (bundle.SHIPPED / values["bundle"] / CARD).write_text(page, encoding="utf-8")


def rewrite_pages(docs: Path = DOCS) -> None:
    """Writes the pages again from results.json, judging nothing."""
    write_pages(docs, json.loads((docs / "results.json").read_text()))


def held_out(name: str, condition: str, expected: Climatology) -> dict[str, Any]:
    """Metrics of the bundle's networks in a scene that they were never trained on, beside the training cases' mean."""
    log.info("held out: %s", condition)
    scene, cases = _condition(condition, bundle.load(name).scene.frame_dt_s)
    return judge(bundle.load(name, scene), cases, expected, START_S).metrics


def _condition(name: str, frame_dt_s: float) -> tuple[Scene, list[Trajectory]]:
    found = open_condition(name, frame_dt_s)
    if found is None:
        raise DataError(
            name, "no such folder of cases", "one in $GNS_DATA or data/", "generate them, docs/full_size.md"
        )
    return found


def long_runs(name: str, scene: Scene) -> dict[str, Any]:
    """Roll-outs several times (at least one: ten times; reduced drums: five) as long as those trained on, beside DEM
    runs of the same length.

    Returns:
        `cases`: per case `duration_s`; `angle_of_repose_deg`, mean over the steady part, and its
        `_standard_error_deg`, each with `_dem`; `escaped_grains`, the most at any frame; `late_mean_speed_m_s` over the
        last half, and `_dem`.

    Raises:
        DataError: for a case that starts as one that the bundle was trained on.
    """
    simulator, card, cases = bundle.load(name), bundle.card(name), []
    for case in _condition(f"{scene.name}_long", scene.frame_dt_s)[1]:
        log.info("long: %s", case.path.name)
        if seen(case, scene, card):
            remedy = "train without the case that starts alike"
            raise DataError(case.path, "a start that the bundle was trained on", "one that it has not seen", remedy)
        start = start_frame(case, START_S)
        times_s, pos = case.times_s[start:], roll_out(simulator, case, start)[0]
        half = len(times_s) // 2
        entry: dict[str, Any] = {"duration_s": float(times_s[-1])}
        entry["escaped_grains"] = int(escaped_grains(pos, times_s, scene).max())
        for suffix, where in (("", pos), ("_dem", positions(case, start))):
            angle, error = time_mean(angle_of_repose(where, scene)[from_frame(times_s, scene) :])
            entry |= {f"angle_of_repose{suffix}_deg": angle, f"angle_of_repose{suffix}_standard_error_deg": error}
            entry[f"late_mean_speed{suffix}_m_s"] = nanmean(mean_speed(where, times_s)[half:])
        cases.append(entry)
    return {"cases": cases}


def spread(per_case: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Standard deviation over cases of every figure that all have; nan for a single case."""
    return {
        key: float(np.std([case[key] for case in per_case], ddof=1)) if len(per_case) > 1 else float("nan")
        for key in per_case[0]
        if key != "case" and all(isinstance(case.get(key), int | float) for case in per_case)
    }


def seed_scatter(cases: Sequence[Trajectory], scene: Scene) -> dict[str, float]:
    """Standard deviation over DEM cases (other seeds) of every observable's mean over the roll-out's time; of the
    angle of repose over its steady part."""
    means: list[dict[str, float]] = []
    for case in cases:
        start = start_frame(case, START_S)
        times_s = case.times_s[start:]
        seen = curves(observe(positions(case, start), times_s, case.radius, case.mass, scene), scene)
        steady = times_s >= (scene.angle_of_repose.from_s if scene.angle_of_repose else 0.0)
        means.append({k: nanmean(c[steady] if k == "angle_of_repose_deg" else c) for k, c in seen.items()})
    return {key: float(np.std([mean[key] for mean in means], ddof=1)) for key in means[0]}


def pictures(evaluation: Evaluation, scene: Scene, folder: Path, name: str) -> None:
    """Writes the figures that the page shows as results_<name>_<figure>.png."""
    for figure_name, figure in draw(evaluation, scene).items():
        if figure_name in PICTURES:
            write_picture(figure, folder / f"results_{name}_{figure_name}.png", dpi=90)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    machine.keep_memory()  # as commands do
    results(DOCS, sys.argv[1:] or REDUCED)

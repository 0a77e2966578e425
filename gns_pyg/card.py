"""The card of a bundle: what a person wants to know of it before use, from the facts that the bundle holds."""

from collections.abc import Mapping
from typing import Any

FILE = "card.md"
ERRORS = [  # what, key, factor, unit, what it is beside: its key and name
    ("one-step error", "one_step_error_m", 1e3, "mm", [("one_step_error_trivial_m", "best trivial predictor")]),
    (
        "roll-out error, last frame",
        "rollout_error_final_m",
        1e3,
        "mm",
        [("rollout_error_final_twin_m", "DEM twins"), ("rollout_error_final_frozen_m", "frozen grains")],
    ),
    (
        "centre of mass, largest error",
        "center_of_mass_error_max_m",
        1e3,
        "mm",
        [("center_of_mass_error_climatology_max_m", "mean of the training cases")],
    ),
    ("angle of repose", "angle_of_repose_deg", 1.0, "degrees", [("angle_of_repose_dem_deg", "DEM")]),
    ("mean speed", "mean_speed_m_s", 1.0, "m/s", [("mean_speed_m_s_dem", "DEM")]),
    ("mean overlap", "mean_overlap_ratio", 100.0, "%", [("mean_overlap_ratio_dem", "DEM")]),
    ("grains that have left", "outflow_final", 100.0, "%", [("outflow_dem_final", "DEM")]),
    ("grains lost, all cases", "escaped_grains", 1.0, "", []),
]


def card_page(description: Mapping[str, Any], metrics: Mapping[str, Any] | None = None) -> str:
    """The card, Markdown.

    Args:
        description: what bundle.json holds.
        metrics: how good it is, as `evaluation.metrics` says it; the bundle's own when None.
    """
    scene, card = description["scene"], description["card"]
    lines = [
        f"# Card of a bundle: {scene['name']}\n",
        "A graph-network surrogate of a granular scene, learned from runs of Yade. Written by gns_pyg.\n",
        "## Scene\n",
        *_table(("what", "value"), _scene(scene)),
        "\n## Data\n",
        *_table(("cases", "files"), _cases(card)),
        "\n## Validity range\n",
        "What the training cases cover. Outside of it a roll-out or evaluation warns; its errors are unknown there.\n",
        *_table(("what", "lowest", "highest"), _coverage(card)),
        "\n## Errors and speed\n",
        *_judged(card.get("metrics") if metrics is None else metrics),
        "\n## Model\n",
        *_table(("the scene requires", "why"), list(description["requires"]["reasons"].items())),
        "\n" + ", ".join(f"{key} {value}" for key, value in description["model"].items()) + ".",
        "\n## Licence\n",
        "MIT, as gns_pyg. bundle.json holds the facts, weights.safetensors the weights; nothing in them is executed.\n",
    ]
    return "\n".join(lines)


def _scene(scene: Mapping[str, Any]) -> list[tuple[str, str]]:
    grains, radii = scene["grains"], scene["grains"]["radius_m"]
    sizes = " and ".join(f"{1e3 * radius:g}" for radius in (radii if isinstance(radii, list) else [radii]))
    walls = [
        f"{name}: {part['shape'].get('kind', '-')}, motion {part['motion']['kind']}"
        for name, part in scene["boundary"].items()
    ]
    return [
        ("grains", f"{grains['count']} of radius {sizes} mm"),
        ("boundary", "; ".join(walls) or "none"),
        ("gravity, m/s²", ", ".join(f"{value:g}" for value in scene["gravity_m_s2"])),
        ("duration of a case, s", f"{scene['duration_s']:g}"),
        ("step of the network, s", f"{scene['frame_dt_s']:g}"),
    ]


def _cases(card: Mapping[str, Any]) -> list[tuple[str, str]]:
    cases, names = card.get("cases", {}), {"train": "trained on", "val": "validated on", "test": "kept unseen"}
    rows = [(text, ", ".join(cases[key])) for key, text in names.items() if cases.get(key)]
    if answers := cases.get("answers"):
        rows.insert(1, ("trained on, DEM's answers to its own states", f"{len(answers)} files"))
    if others := seen_earlier(card):
        rows.append(("trained on earlier, before training.start_from", f"{others} others"))
    return rows


def seen_earlier(card: Mapping[str, Any]) -> int:
    """How many cases its weights had seen, beside its own, in the bundle that training started from."""
    cases = card.get("cases", {})
    return max(0, len(card.get("starts", [])) - len(cases.get("train", {})) - len(cases.get("val", {})))


def _coverage(card: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    return [(what, _digits(low), _digits(high)) for what, (low, high) in card.get("coverage", {}).items()]


def _judged(metrics: Mapping[str, Any] | None) -> list[str]:
    """Errors, each beside its yardstick, and the speed that they bought."""
    if not metrics:
        return ["Not judged: no case was left that it had not seen."]
    judged = {key.removeprefix("test/"): value for key, value in metrics.items() if value is not None}
    rows = [
        (
            what,
            f"{_digits(judged[key], factor)} {unit}".rstrip(),
            ", ".join(f"{_digits(judged[k], factor)} {name}" for k, name in beside if k in judged),
        )
        for what, key, factor, unit, beside in ERRORS
        if key in judged
    ]
    own, yade = (metrics[f"speed/{name}seconds_per_simulated_second"] for name in ("", "yade_"))
    beside = f"{_digits(yade)} Yade (dt {1e6 * metrics['speed/yade_dt_s']:.0f} µs, {metrics['speed/yade_cores']} core)"
    rows.append(("seconds per simulated second", f"{_digits(own)} on {metrics.get('speed/device', '-')}", beside))
    return ["Mean over the unseen cases.\n", *_table(("what", "network", "beside"), rows)]


def _table(heading: tuple[str, ...], rows: list[Any]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (heading, ("---",) * len(heading), *rows)]


def _digits(value: int | float, factor: float = 1.0) -> str:
    return f"{factor * value:.4g}"

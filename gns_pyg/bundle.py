"""A trained simulator as one folder: weights.safetensors, bundle.json, and card.md, the same for a person. Data only,
nothing executable."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from gns_pyg.card import FILE as CARD
from gns_pyg.card import card_page
from gns_pyg.config import typed
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import BundleError
from gns_pyg.files import whole
from gns_pyg.models.impulse_network import Damping
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints, boundary_points
from gns_pyg.scene.requirements import Requirements, transferred
from gns_pyg.scene.scene import Scene

FORMAT_VERSION = 2
FARTHEST_M = 1e6  # of a boundary point from the origin
REMEDY = "copy the bundle again, or train again"
SHIPPED = Path(__file__).parent / "bundles"


def find(name: str | Path) -> Path:
    """A bundle's folder: `name` itself, or the bundle of that name that ships with the project."""
    shipped = SHIPPED / name
    return shipped if not Path(name).exists() and shipped.is_dir() else Path(name)


def save(folder: str | Path, simulator: Simulator, card: Mapping[str, Any]) -> Path:
    """Writes a bundle under a temporary name, then gives it its final name; an old bundle there is replaced.

    Args:
        folder: where the bundle goes.
        simulator: the trained simulator.
        card: what it was trained on and how good it is (plain values).

    Raises:
        StorageError: if it cannot be written; the old one stays.
    """
    folder = Path(folder)
    weights = {key: value.detach().cpu().contiguous() for key, value in simulator.state_dict().items()}
    description = {
        "format_version": FORMAT_VERSION,
        "scene": asdict(simulator.scene),
        "model": asdict(simulator.config),
        "requires": asdict(simulator.requires),
        "statistics": asdict(simulator.statistics),
        "card": dict(card),
    }
    with whole(folder) as temporary:
        temporary.mkdir()
        try:
            save_file(weights, temporary / "weights.safetensors")
        except SafetensorError as error:  # an OSError in its clothes
            raise OSError(str(error)) from None
        (temporary / "bundle.json").write_text(json.dumps(description, indent=1))
        (temporary / CARD).write_text(card_page(description), encoding="utf-8")
    return folder


def describe(folder: str | Path) -> dict[str, Any]:
    """Reads and checks bundle.json.

    Raises:
        BundleError: if it is missing, not JSON, or of another format version.
    """
    path = find(folder) / "bundle.json"
    try:
        description = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise BundleError(path, str(error), "a bundle folder written by train.py", "check bundle=PATH") from None
    version = description.get("format_version") if isinstance(description, dict) else None
    if version != FORMAT_VERSION:
        raise BundleError(
            path,
            f"format version {version}",
            f"format version {FORMAT_VERSION}",
            "train again, or use the gns_pyg version that wrote this bundle",
        )
    return description


def card(folder: str | Path) -> dict[str, Any]:
    """What a trained bundle was trained on and how good it is; `save` takes it, `run.train` writes it.

    Raises:
        BundleError: if something in it has not the shape that judging and rolling out rely on.
    """
    path, found = find(folder) / "bundle.json", cast(dict[str, Any], describe(folder).get("card"))
    try:
        hashes = [digest for purpose in ("train", "val", "test") for digest in found["cases"][purpose].values()]
        curves = {key: np.array(curve, float) for key, curve in found["climatology"].items() if curve is not None}
        n_frames = len(curves["times_s"])
        shapes = {key: (n_frames, 3) if key == "center_of_mass_m" else (n_frames,) for key in curves}
        sound = {
            "cases": all(isinstance(digest, str) for digest in hashes),
            "climatology": all(curves[key].shape == shape for key, shape in shapes.items())
            and found["climatology"].keys() == {"times_s", "center_of_mass_m", "angle_of_repose_deg", "outflow"}
            and {"times_s", "center_of_mass_m"} <= curves.keys(),
            "coverage": all(
                len(limits) == 2 and all(type(limit) in (int, float) for limit in limits)
                for limits in found["coverage"].values()
            ),
            "starts": all(np.array(start, float).shape[1:] == (3,) for start in found.get("starts", [])),
        }
        wrong = ", ".join(f"card.{key}" for key, holds in sound.items() if not holds)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        wrong = f"card: {type(error).__name__}: {error}"
    if wrong:
        raise BundleError(path, wrong, "a card as train.py writes it", REMEDY)
    return found


def load(folder: str | Path, scene: Scene | None = None) -> Simulator:
    """Rebuilds the simulator of a bundle, in evaluation mode, on the CPU.

    Args:
        folder: the bundle, or the name of one that ships with the project.
        scene: another scene to simulate with the same networks (other gravity, motion, boundary, ...); the bundle's
            own when None.

    Raises:
        BundleError: if a file is missing or damaged, the format version differs, or weights do not fit the model.
        ConfigError: if the other scene needs something that the model does not have.
    """
    folder, description = find(folder), describe(folder)
    own = Scene.from_config(description.get("scene"))
    requires = typed(Requirements, description.get("requires"), "requires")
    model = typed(ModelConfig, description.get("model"), "model")
    path = folder / "weights.safetensors"
    try:
        weights = _damping_felt(load_file(path))
        _check_weights(path, weights, model)
        if scene is None:
            points = {name: _points(path, weights, part) for part, name in enumerate(own.boundary)}
        else:
            requires = transferred(requires, own, scene)
            points = boundary_points(scene, model.cutoff_wall_radii)
            weights = {key: value for key, value in weights.items() if not key.startswith("boundary.")}
        statistics = typed(Statistics, description.get("statistics"), "statistics")
        simulator = Simulator(scene or own, model, requires, points, statistics)
        if len(simulator.scale) != 3 * (groups := simulator.integrator.n_groups):
            raise BundleError(path.with_name("bundle.json"), f"{statistics}", f"{groups} scales of corrections", REMEDY)
        if scene is not None:
            weights |= {f"boundary.{k}": v for k, v in (simulator.boundary or nn.Module()).state_dict().items()}
        simulator.load_state_dict(weights)
    except (OSError, SafetensorError, KeyError, RuntimeError) as error:
        raise BundleError(path, str(error), "the weights of the model in bundle.json", REMEDY) from None
    return simulator.eval()


def _damping_felt(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """`weights`; where they are of before 29 November 2026, their damping with the factor `Damping.FELT`, 0."""
    for name in ("damping.shares.2.weight", "damping.shares.2.bias"):
        if name in weights and len(weights[name]) == Damping.FELT.start:
            lacking = weights[name].new_zeros(Damping.FELT.stop - Damping.FELT.start, *weights[name].shape[1:])
            weights[name] = torch.cat([weights[name], lacking])
    return weights


def _check_weights(path: Path, weights: Mapping[str, Tensor], model: ModelConfig) -> None:
    """Refuses values that are not finite, and a model whose networks are larger than all that is stored: building it
    first would take the memory that it claims."""
    for name, tensor in weights.items():
        if not (tensor.is_floating_point() and torch.isfinite(tensor).all()):
            raise BundleError(path, f"{name}: {tensor.dtype}, or not finite", "finite floating-point values", REMEDY)
    stored = sum(tensor.numel() for name, tensor in weights.items() if not name.startswith("boundary."))
    claimed = model.hidden**2 * model.layers * model.mlp_layers
    if claimed > stored:
        raise BundleError(path, f"{stored} weights", f"at least {claimed}, for the model in bundle.json", REMEDY)


def _points(path: Path, weights: Mapping[str, Tensor], part: int) -> BoundaryPoints:
    pos, normal = (weights[f"boundary.parts.{part}.{key}"] for key in ("pos", "normal"))
    if pos.ndim != 2 or pos.shape[1] != 3 or pos.shape != normal.shape or not len(pos):
        found = f"boundary points {tuple(pos.shape)} with normals {tuple(normal.shape)}"
        raise BundleError(path, found, "(n, 3) of each", REMEDY)
    if pos.abs().max() > FARTHEST_M or normal.abs().max() > 1 + 1e-6:
        raise BundleError(path, "boundary points too far away, or normals too long", "metres; at most 1", REMEDY)
    return BoundaryPoints(pos.numpy(), normal.numpy())

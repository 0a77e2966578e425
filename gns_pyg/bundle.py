"""A trained simulator as one folder: weights.safetensors and bundle.json. Data only, nothing executable."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from gns_pyg.config import typed
from gns_pyg.dynamics.model_config import ModelConfig
from gns_pyg.dynamics.simulator import Simulator
from gns_pyg.errors import BundleError
from gns_pyg.models.statistics import Statistics
from gns_pyg.scene.boundary_points import BoundaryPoints, boundary_points
from gns_pyg.scene.requirements import Requirements, check_covers
from gns_pyg.scene.scene import Scene

FORMAT_VERSION = 2
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
    """
    folder = Path(folder)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    weights = {key: value.detach().cpu().contiguous() for key, value in simulator.state_dict().items()}
    save_file(weights, temporary / "weights.safetensors")
    description = {
        "format_version": FORMAT_VERSION,
        "scene": asdict(simulator.scene),
        "model": asdict(simulator.config),
        "requires": asdict(simulator.requires),
        "statistics": asdict(simulator.statistics),
        "card": dict(card),
    }
    (temporary / "bundle.json").write_text(json.dumps(description, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(temporary, folder)
    return folder


def describe(folder: str | Path) -> dict[str, Any]:
    """Reads and checks bundle.json.

    Raises:
        BundleError: if it is missing, not JSON, or of another format version.
    """
    path = find(folder) / "bundle.json"
    try:
        description = json.loads(path.read_text())
    except (OSError, ValueError) as error:
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
        weights = load_file(path)
        if scene is None:
            points = {
                name: BoundaryPoints(*(weights[f"boundary.parts.{part}.{key}"].numpy() for key in ("pos", "normal")))
                for part, name in enumerate(own.boundary)
            }
        else:
            check_covers(requires, scene)
            requires = replace(requires, active_mask=scene.outlet is not None or scene.inlet is not None)
            points = boundary_points(scene, model.cutoff_wall_radii)
            weights = {key: value for key, value in weights.items() if not key.startswith("boundary.")}
        statistics = typed(Statistics, description.get("statistics"), "statistics")
        simulator = Simulator(scene or own, model, requires, points, statistics)
        if scene is not None:
            weights |= {f"boundary.{k}": v for k, v in (simulator.boundary or nn.Module()).state_dict().items()}
        simulator.load_state_dict(weights)
    except (OSError, SafetensorError, KeyError, RuntimeError) as error:
        raise BundleError(
            path, str(error), "the weights of the model in bundle.json", "copy the bundle again, or train again"
        ) from None
    return simulator.eval()

"""What a scene requires of its model: derived from the scene, printable, and open to ablation.

`resolve` turns a scene into a `Requirements`; nothing that it does not name is built or computed. Every row can be
forced by one config key (conf/requires/*.yaml), unless that would leave out what the scene has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Union

from gns_pyg.config import require
from gns_pyg.errors import ConfigError
from gns_pyg.scene.scene import PARAMETERS, STATES, Scene
from gns_pyg.scene.symmetry import symmetry


@dataclass
class Requires:
    """Config: `auto` derives a row from the scene, true or false forces it. See `Requirements` for the rows."""

    wall_network: Union[bool, str] = "auto"
    wall_velocity: Union[bool, str] = "auto"
    wall_friction: Union[bool, str] = "auto"
    static_walls: Union[bool, str] = "auto"
    reachable_points: Union[bool, str] = "auto"
    nearest_points: Union[bool, str] = "auto"
    free_flight: Union[bool, str] = "auto"
    free_grains: Union[bool, str] = "auto"
    touching_pairs: Union[bool, str] = "auto"
    radius_features: Union[bool, str] = "auto"
    material_features: Union[bool, str] = "auto"
    symmetry: Union[bool, str] = "auto"
    active_mask: Union[bool, str] = "auto"
    rest: Union[bool, str] = "auto"
    damped: Union[bool, str] = "auto"
    state: str = "auto"

    def __post_init__(self) -> None:
        for row, value in asdict(self).items():
            known = ("auto", *STATES) if row == "state" else ("auto", True, False)
            ok = value in known and (row == "state" or value == "auto" or isinstance(value, bool))
            require(ok, f"requires.{row}", value, " or ".join(map(str, known)).lower(), "auto derives it")


@dataclass(frozen=True)
class Requirements:
    """What a model of a scene is made of.

    Attributes:
        wall_network: the second network, for grain-boundary contact.
        wall_velocity: velocity of boundary points as a feature.
        wall_friction: friction angle of boundary points as a feature.
        static_walls: points are placed and their search structure is built once; a moving part is searched in its
            own frame, where it is static too.
        reachable_points: only boundary points and grains within reach of each other enter the wall network.
        nearest_points: of the boundary points on one plane, a grain has the nearest only.
        free_flight: the scene's law for a grain that touches nothing is subtracted, not learned.
        free_grains: grains that can touch nothing within the frame follow that law, outside the networks.
        touching_pairs: only pairs (and boundary points) that can touch within the frame exchange anything.
        radius_features: each grain's radius as a feature.
        material_features: parameters (of `scene.PARAMETERS`) that condition the networks.
        symmetry: training windows are turned and mirrored by the scene's own symmetry.
        active_mask: grains leave or enter.
        rest: a grain that stands stays (see `dynamics.rest`).
        damped: the DEM's damping takes from what grains give each other; impulse networks learn how much.
        state: what the state holds (see `dynamics.integrator`).
        reasons: row -> why, for people.
    """

    wall_network: bool
    wall_velocity: bool
    wall_friction: bool
    static_walls: bool
    reachable_points: bool
    free_flight: bool
    free_grains: bool
    radius_features: bool
    material_features: list[str]
    symmetry: bool
    active_mask: bool
    state: str
    rest: bool = False  # bundles made before have none
    damped: bool = False  # nor this
    touching_pairs: bool = False  # nor this
    nearest_points: bool = False  # nor this
    reasons: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        shown = {True: "yes", False: "no"}
        rows = {row: value for row, value in asdict(self).items() if row != "reasons"}
        texts = {row: ", ".join(v) or "no" if isinstance(v, list) else shown.get(v, v) for row, v in rows.items()}
        width = max(map(len, texts.values()))
        return "\n".join(f"  {row:<18} {text:<{width}}  {self.reasons.get(row, '')}" for row, text in texts.items())


LOST = {  # row -> what is lost when it is forced off although the scene has it; the others are judgement
    "wall_network": "grains would fall through the boundary",
    "wall_velocity": "moving walls would look like standing ones",
    "active_mask": "grains that have left or not yet entered would take part",
}


def resolve(scene: Scene, parameters: Mapping[str, Sequence[float]], requires: Requires) -> Requirements:
    """Derives what `scene` requires.

    Args:
        scene: what is simulated.
        parameters: what only the data can tell: every parameter (of `scene.PARAMETERS`) -> its values in the cases.
        requires: rows that are forced.

    Raises:
        ConfigError: for a forced row that contradicts the scene; says what would be lost.
    """
    derived = _derive(scene, parameters)
    rows: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for row, (value, reason) in derived.items():
        forced = getattr(requires, row)
        rows[row], reasons[row] = value, reason
        if forced == "auto" or forced == value:
            continue
        if forced is False and row in LOST:
            raise ConfigError(f"requires.{row}", "false", f"true: {reason}", f"{LOST[row]}; set requires.{row}=auto")
        rows[row], reasons[row] = forced, f"forced; {reason}"
    if not isinstance(rows["material_features"], list):
        rows["material_features"] = list(PARAMETERS) if rows["material_features"] else []
    for row, law in (("free_grains", "free_flight"), ("touching_pairs", "free_grains"), ("rest", "free_flight")):
        if getattr(requires, row) == "auto":
            rows[row] = rows[row] and rows[law]
    for row in ("wall_velocity", "wall_friction", "static_walls", "reachable_points", "nearest_points"):
        carried = rows["wall_network"] or not rows[row]
        require(carried, f"requires.{row}", "true", "a wall network to carry it", "set requires.wall_network=true too")
    flies = rows["free_flight"] or not rows["free_grains"]
    law = "grains that the networks leave out follow the free-flight law"
    require(flies, "requires.free_grains", "true without requires.free_flight", law, "set requires.free_grains=false")
    fly = rows["free_grains"] or not rows["touching_pairs"]
    none = "grains without a pair follow the free-flight law"
    require(
        fly, "requires.touching_pairs", "true without requires.free_grains", none, "set requires.touching_pairs=false"
    )
    found = derived["symmetry"][1]
    symmetric = derived["symmetry"][0] or not rows["symmetry"]
    require(symmetric, "requires.symmetry", "true", f"false: {found}", "set requires.symmetry=auto")
    return Requirements(**rows, reasons=reasons)


def check_covers(trained: Requirements, scene: Scene) -> None:
    """Checks that a model built for `trained` has all that another scene needs.

    Raises:
        ConfigError: if it lacks something; names it.
    """
    needed = _derive(scene, {})
    for row in ("wall_network", "wall_velocity"):
        has = getattr(trained, row) or not needed[row][0]
        remedy = f"{LOST[row]}: train on a scene that has it"
        require(has, f"requires.{row}", "false in the bundle", f"true: {needed[row][1]}", remedy)


def stands(scene: Scene) -> bool:
    """Whether grains can come to rest in a scene: gravity holds them down, and no wall moves."""
    return any(scene.gravity_m_s2) and not any(part.motion.moves for part in scene.boundary.values())


def transferred(trained: Requirements, own: Scene, scene: Scene) -> Requirements:
    """What a model that was trained for `own` is made of in another scene: its networks stay what they are.

    Raises:
        ConfigError: if the model lacks what the other scene needs (see `check_covers`).
    """
    check_covers(trained, scene)
    rest = stands(scene) and trained.free_flight and (trained.rest or not stands(own))
    return replace(trained, active_mask=scene.outlet is not None or scene.inlet is not None, rest=rest)


def _derive(scene: Scene, parameters: Mapping[str, Sequence[float]]) -> dict[str, tuple[Any, str]]:
    """Row -> (what the scene requires, why)."""
    parts, radii = scene.boundary, scene.grains.radii_m
    moving = [name for name, part in parts.items() if part.motion.moves]
    frictions = {part.friction_angle_rad for part in parts.values()}
    varying = [name for name in PARAMETERS if len(set(parameters.get(name, ()))) > 1]
    passing = [name for name in ("outlet", "inlet") if getattr(scene, name) is not None]
    own = symmetry(scene)
    return {
        "wall_network": (bool(parts), f"boundary: {', '.join(parts)}" if parts else "no boundary: no wall network"),
        "wall_velocity": (
            bool(moving),
            f"moving: {', '.join(moving)}" if moving else "no part moves: no wall-velocity feature",
        ),
        "wall_friction": (
            len(frictions) > 1,
            f"wall friction angles, rad: {', '.join(map(str, sorted(frictions))) or 'none'}",
        ),
        "static_walls": (bool(parts), _search(len(parts), len(moving))),
        "reachable_points": (bool(parts), "points and grains out of reach stay out" if parts else "no boundary"),
        "nearest_points": (False, "only where asked for: of a plane's points all but the nearest stay out"),
        "free_flight": (True, f"gravity {scene.gravity_m_s2} m/s^2 with damping {scene.damping} is known, not learned"),
        "free_grains": (True, "grains that can touch nothing within a frame follow it"),
        "touching_pairs": (False, "only where asked for: pairs that cannot touch within a frame stay out"),
        "radius_features": (
            len(radii) > 1,
            f"{len(radii)} radii" if len(radii) > 1 else "one radius: no radius feature",
        ),
        "material_features": (varying, "vary between cases" if varying else "one material: no material feature"),
        "symmetry": (not own.trivial, own.describe()),
        "active_mask": (bool(passing), " and ".join(passing) or "no grain leaves or enters: no mask"),
        "rest": (stands(scene), _standing(scene, moving)),
        "damped": _damped(scene, varying),
        "state": (scene.state, "as data_gen.restart measured it (docs/state.md)"),
    }


def _damped(scene: Scene, varying: Sequence[str]) -> tuple[bool, str]:
    if "damping" in varying:
        return True, "damping varies"
    return scene.damping > 0, f"damping {scene.damping:g} acts on every grain" if scene.damping else "no damping"


def _standing(scene: Scene, moving: Sequence[str]) -> str:
    if moving:
        return f"moving: {', '.join(moving)}: nothing comes to rest"
    return "a grain that stands stays" if any(scene.gravity_m_s2) else "no gravity: nothing comes to rest"


def _search(n_parts: int, n_moving: int) -> str:
    if n_parts == 0:
        return "no boundary: nothing to search"
    if n_moving == 0:
        return "no moving part: boundary placed and its search built once"
    return f"{n_moving} of {n_parts} parts move: searched in their own frames, built once"

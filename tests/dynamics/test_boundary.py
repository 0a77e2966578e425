"""Which boundary points grains have, and which of a plane's points where one is enough."""

import torch

from tests import scenes
from tests.simulators import simulator, state_in_box

NARROW = {"kind": "box", "size_m": [0.2, 0.2, 0.2], "center_m": [0.0, 0.0, 0.0]}


def test_of_a_plane_s_points_a_grain_has_the_nearest() -> None:
    """Grains all over a box, whose corners three planes share; some reach no point."""
    scene = scenes.scene(200, 5, boundary={"walls": {"shape": NARROW, "points": 600, "friction_angle_rad": 0.5}})
    state = state_in_box([200], half_m=0.09)
    every, few = (simulator(scene, nearest_points=few).boundary for few in (False, True))
    found = {}
    for name, boundary in (("every", every), ("few", few)):
        walls, (point, grain) = boundary.contacts(state)
        distance = (walls.pos[point] - state.pos[grain]).norm(dim=1)
        found[name] = list(
            zip(grain.tolist(), map(tuple, walls.normal[point].tolist()), distance.tolist(), strict=True)
        )
    nearest: dict = {}
    for grain, normal, distance in found["every"]:
        nearest[grain, normal] = min(distance, nearest.get((grain, normal), torch.inf))
    assert len(found["few"]) == len(nearest) < len(found["every"]) / 2
    assert {(grain, normal): distance for grain, normal, distance in found["few"]} == nearest
    assert len({grain for grain, _ in nearest}) < len(nearest)

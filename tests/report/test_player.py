"""What the player gets: packed frames that say what the roll-out says, in the space they may take."""

import base64
import json
import re
import zlib

import numpy as np
import pytest

from gns_pyg.evaluation.metrics import CaseResult
from gns_pyg.report.player import ABSENT, UNKNOWN, player
from tests import scenes


def result(pos, dem_pos=None, name="case_000", radius_m=scenes.RADIUS_M, frame_dt_s=0.01):
    """A case of positions (n_frames, n_grains, 3), DEM's being the same where not given."""
    n_frames, n_grains = pos.shape[:2]
    times_s, nothing = frame_dt_s * np.arange(n_frames), np.zeros(0)
    dem_pos = pos if dem_pos is None else dem_pos
    radius, mass = np.full(n_grains, radius_m), np.ones(n_grains)
    return CaseResult(name, times_s, dem_pos, pos, radius, mass, nothing, nothing, {}, 1.0, 1.0, 1, 1e-4)


def script(page, identity):
    return re.search(rf'<script[^>]*id="{identity}">(.*?)</script>', page, re.DOTALL)[1]


def unpack(page):
    """Meta data, stored positions (view, frame, grain, 3), shades by mode and view, radii: as player.js reads them."""
    meta = json.loads(script(page, "player-meta"))
    content = np.frombuffer(zlib.decompress(base64.b64decode(script(page, "player-frames"))), np.uint8)
    shape = (len(meta["times_s"]), meta["grains"])
    n, at = shape[0] * shape[1], 0

    def take(length):
        nonlocal at
        at += length
        return content[at - length : at]

    def together(frames):
        return np.cumsum(frames, axis=0, dtype=frames.dtype)

    positions = []
    for _ in meta["views"]:
        low, high = take(3 * n).astype(np.uint16), take(3 * n).astype(np.uint16)
        positions.append(together((low | (high << 8)).reshape(*shape, 3)))
    shades = []
    for mode in meta["modes"]:
        own = [together(take(n).reshape(shape)) for _ in range(1 if mode["shared"] else 2)]
        shades.append([own[0], own[-1]])
    return meta, np.array(positions), shades, content[at:].view("<f4")


def walk(n_frames=40, n_grains=30, seed=0):
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 2e-3, (n_frames, n_grains, 3))
    steps[0] = rng.uniform(-0.4, 0.4, (n_grains, 3))
    return steps.cumsum(axis=0)


def test_positions_come_back_within_half_a_unit_and_radii_as_they_are():
    pos, dem_pos = walk(seed=1), walk(seed=2)
    meta, stored, _, radii = unpack(player(result(pos, dem_pos), scenes.scene(30, 40)))
    found = np.array(meta["origin_m"]) + meta["unit_m"] * stored
    np.testing.assert_allclose(found, [dem_pos, pos], atol=0.51 * meta["unit_m"])
    assert meta["unit_m"] <= scenes.RADIUS_M / 32
    np.testing.assert_allclose(radii, scenes.RADIUS_M, rtol=1e-6)
    np.testing.assert_allclose(meta["times_s"], 0.01 * np.arange(40))


def test_colours_are_speed_distance_from_dem_and_contacts():
    """One grain runs at 1 m/s, in the network at 2 m/s; two others touch in DEM, none in the network."""
    still = np.array([[0.0, 0.1, 0.0], [0.0, 0.1, 0.019]])
    dem_pos = np.array([[[0.01 * frame, 0, 0], *still] for frame in range(11)])
    pos = np.array([[[0.02 * frame, 0, 0], still[0], still[1] + [0, 0, 0.01]] for frame in range(11)])
    meta, _, (speed, distance, contacts), _ = unpack(player(result(pos, dem_pos), scenes.scene(3, 11)))
    tops = [mode["top"] for mode in meta["modes"]]
    read = [np.array(shade) / (UNKNOWN - 1) * top for shade, top in zip((speed, distance, contacts), tops, strict=True)]
    np.testing.assert_allclose(read[0][:, :, 0], [[1.0] * 11, [2.0] * 11], atol=0.01)
    np.testing.assert_allclose(read[1][0, 1:10, 0], 10.0 * np.arange(1, 10), atol=0.3)
    np.testing.assert_array_equal(read[1][0], read[1][1])
    np.testing.assert_allclose(read[2], [[[0, 1, 1]] * 11, [[0, 0, 0]] * 11])
    assert [mode["unit"] for mode in meta["modes"]] == ["m/s", "mm", ""]


def test_grains_that_are_absent_or_far_away_are_not_drawn_and_cost_no_resolution():
    pos, dem_pos = walk(), walk()
    pos[5:, 0] = np.nan
    pos[5:, 1] = 1e6
    meta, stored, (speed, *_), _ = unpack(player(result(pos, dem_pos), scenes.scene(30, 40)))
    gone = (stored[1] == ABSENT).all(axis=2)
    assert gone[5:, :2].all()
    assert not gone[:5].any()
    assert not gone[:, 2:].any()
    assert (speed[1][5:, 0] == UNKNOWN).all()
    assert meta["unit_m"] <= scenes.RADIUS_M / 32


def test_frames_are_left_out_to_keep_the_budget_and_the_page_says_so():
    pos = walk(60, 200)
    page = player(result(pos), scenes.scene(200, 60), budget_bytes=40_000)
    meta = unpack(page)[0]
    assert len(script(page, "player-frames")) <= 40_000
    assert 2 < len(meta["times_s"]) < 60
    assert meta["times_s"][0] == 0.0
    assert meta["times_s"][-1] == pytest.approx(0.59)
    assert "holds one frame in " in meta["remark"]
    assert "holds one frame in " not in player(result(pos), scenes.scene(200, 60))


def test_a_turning_wall_carries_how_far_it_has_come(tmp_path):
    turning = scenes.rotating_box_case(tmp_path / "c.h5", n_frames=11, rate_rad_s=8.0)
    wall = unpack(player(result(walk(11, 36)), turning))[0]["walls"][0]
    np.testing.assert_allclose(wall["way"], 8.0 * 0.01 * np.arange(11))
    assert wall["turns"]
    assert wall["axis"] == [1.0, 0.0, 0.0]
    assert unpack(player(result(walk(11, 3)), scenes.scene(3, 11)))[0]["walls"][0]["way"] == []


def test_a_name_cannot_break_out_of_the_page():
    page = player(result(walk(3, 3), name="</script><b>"), scenes.scene(3, 3))
    assert "</script><b>" not in page
    assert "</script><b>" in unpack(page)[0]["remark"]

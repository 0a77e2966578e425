"""When and where grains enter through a scene's inlet: a fixed plan, the same for the DEM and for a roll-out."""

import math
from dataclasses import dataclass

import numpy as np

from gns_pyg.config import require
from gns_pyg.scene.scene import Scene

PITCH = 2.1  # edge of the inlet's cells, in largest radii: grains in neighbouring cells cannot touch


@dataclass(frozen=True)
class Entries:
    """Grains that enter, in order; they are the last ones of the scene.

    Attributes:
        time_s: (n,) a grain is there from the first frame at or after its time.
        pos: where it is then, m, (n, 3).
        vel: how fast, m/s, (n, 3); it does not spin.
    """

    time_s: np.ndarray
    pos: np.ndarray
    vel: np.ndarray


def entries(scene: Scene) -> Entries:
    """The plan of a scene's inlet; empty where there is none.

    The rectangle is divided into cells that are taken in a random, fixed order, so that no grain enters where the one
    before it still is.

    Raises:
        ConfigError: for a rectangle without room for a grain, or a rate at which entering grains would overlap.
    """
    inlet = scene.inlet
    if inlet is None:
        return Entries(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    largest, generator = scene.grains.radii_m[-1], np.random.default_rng(scene.seed)
    n = np.floor(np.array(inlet.size_m) / (PITCH * largest) + 1e-9).astype(int)
    room = f"at least {PITCH * largest:g} m each way, room for one grain"
    require(bool((n >= 1).all()), "scene.inlet.size_m", inlet.size_m, room, "widen the inlet")
    speed = float(np.linalg.norm(inlet.velocity_m_s))
    frames = max(math.ceil(PITCH * largest / max(speed * scene.frame_dt_s, 1e-12) - 1e-9), 1)
    fastest = int(n.prod()) / (frames * scene.frame_dt_s)  # a cell is free again after so many frames
    possible = (
        f"at most {fastest:.4g} grains per second for this size and velocity, in frames of {scene.frame_dt_s:g} s"
    )
    require(inlet.rate_per_s <= fastest, "scene.inlet.rate_per_s", inlet.rate_per_s, possible, "lower it")
    pitch = np.array(inlet.size_m) / n
    cells = np.stack(np.divmod(generator.permutation(n.prod()), n[1]), axis=1)
    cells = cells[np.arange(inlet.count) % len(cells)]
    jitter = generator.uniform(-0.5, 0.5, (inlet.count, 2)) * (pitch - 2 * largest)
    plane = np.array(inlet.center_m[:2]) - np.array(inlet.size_m) / 2 + (cells + 0.5) * pitch + jitter
    pos = np.column_stack([plane, np.full(inlet.count, inlet.center_m[2])])
    time_s = np.arange(1, inlet.count + 1) / inlet.rate_per_s
    return Entries(time_s, pos, np.tile(np.array(inlet.velocity_m_s, np.float64), (inlet.count, 1)))

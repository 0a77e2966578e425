"""Poses of a scene's symmetry: what holds in one holds in all."""

import torch

from gns_pyg.scene.symmetry import Symmetry
from gns_pyg.state import Window
from gns_pyg.training.augment import transform

CENTER = [0.3, 0.1, 0.0]
ROUND = Symmetry(fold=0, mirror=[1.0, 0.0, 0.0], axis=[0.0, 0.0, 1.0], center_m=CENTER)


def rolling(n_graphs=6, n_grains=5):
    """Grains that turn rigidly about a point each graph has of its own: v = w x (x - origin)."""
    random = torch.Generator().manual_seed(0)
    n = n_graphs * n_grains
    batch = torch.arange(n_graphs).repeat_interleave(n_grains)
    pos = torch.rand(3, n, 3, generator=random, dtype=torch.float64)
    spin = torch.rand(n_graphs, 3, generator=random, dtype=torch.float64)[batch].expand(3, n, 3)
    return Window(
        pos=pos,
        vel=torch.linalg.cross(spin, pos - torch.tensor(CENTER, dtype=torch.float64)),
        ang_vel=spin,
        radius=torch.full((n,), 0.01, dtype=torch.float64),
        time_s=torch.zeros(n_graphs, dtype=torch.float64),
        batch=batch,
        parameters=torch.zeros(n_graphs, 5, dtype=torch.float64),
    )


def test_rolling_stays_rolling():
    window = rolling()
    before = window.pos.clone()
    turned = transform(window, ROUND, [torch.Generator().manual_seed(k) for k in range(6)])
    arm = turned.pos - torch.tensor(CENTER, dtype=torch.float64)
    torch.testing.assert_close(turned.vel, torch.linalg.cross(turned.ang_vel, arm))
    torch.testing.assert_close(turned.pos[..., 2], window.pos[..., 2])
    torch.testing.assert_close(window.pos, before)


def test_every_graph_has_its_own_pose_and_keeps_its_distances():
    window = rolling()
    turned = transform(window, ROUND, [torch.Generator().manual_seed(k) for k in range(6)])
    center = torch.tensor(CENTER, dtype=torch.float64)
    elements = []
    for graph in range(6):
        here = window.batch == graph
        for frame in range(3):
            before, after = window.pos[frame, here], turned.pos[frame, here]
            torch.testing.assert_close(torch.cdist(after, after), torch.cdist(before, before))
        solution = torch.linalg.lstsq(
            (window.pos[:, here] - center).reshape(-1, 3), (turned.pos[:, here] - center).reshape(-1, 3)
        )
        elements.append(solution.solution)
    assert len({tuple(q.flatten().round(decimals=6).tolist()) for q in elements}) == 6
    assert {round(float(torch.linalg.det(q))) for q in elements} == {1, -1}


def test_no_symmetry_no_change():
    window = rolling()
    assert transform(window, Symmetry(1, None, [0.0, 0.0, 1.0], CENTER), [torch.Generator()]) is window

"""Training windows in other poses that the scene cannot tell apart."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from gns_pyg.scene.symmetry import Symmetry
from gns_pyg.state import Window


def transform(window: Window, symmetry: Symmetry, generators: Sequence[torch.Generator]) -> Window:
    """A copy of `window` with every graph mapped by its own element of the scene's symmetry, drawn from its generator.

    Angular velocity is an axial vector: a reflection turns it the other way than a velocity.
    """
    if symmetry.trivial:
        return window
    drawn = torch.cat([symmetry.draw(1, generator) for generator in generators]).to(window.pos)
    center = torch.tensor(symmetry.center_m, dtype=torch.float64).to(window.pos)
    q, hand = drawn[window.batch], torch.linalg.det(drawn)[window.batch, None]
    return replace(
        window,
        pos=torch.einsum("gij,fgj->fgi", q, window.pos - center) + center,
        vel=torch.einsum("gij,fgj->fgi", q, window.vel),
        ang_vel=hand * torch.einsum("gij,fgj->fgi", q, window.ang_vel),
    )

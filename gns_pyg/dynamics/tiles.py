"""A scene in pieces that are computed one after the other, so that memory follows the piece and not the scene."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor


def tiles(
    pos: Float[Tensor, "n_grains 3"], most: int, halo_m: float
) -> Iterator[tuple[Int[Tensor, " n_core"], Int[Tensor, " n_region"]]]:
    """Cuts grains in boxes of at most `most`, each halved along its longest side until it is small enough.

    Args:
        pos: grain centres, m.
        most: grains in a tile, at least 1.
        halo_m: width of the margin that what happens in a tile depends on.

    Yields:
        The grains of a tile, every grain in one tile only, and, sorted, those of its box with the margin.
    """
    everyone = torch.arange(len(pos), device=pos.device)
    stack = [(everyone, everyone)]
    while stack:
        core, region = stack.pop()
        if len(core) <= most:
            yield core, region
            continue
        inside = pos[core]
        axis = int((inside.amax(0) - inside.amin(0)).argmax())
        order = core[inside[:, axis].argsort()]
        for half in order.tensor_split(2):
            low, high = pos[half[0], axis] - halo_m, pos[half[-1], axis] + halo_m
            stack.append((half, region[(pos[region, axis] >= low) & (pos[region, axis] <= high)]))


def ball(
    pos: Float[Tensor, "n_grains 3"],
    batch: Int[Tensor, " n_grains"],
    most: int,
    halo_m: float,
    randoms: Sequence[torch.Generator],
) -> tuple[Int[Tensor, " n_core"], Int[Tensor, " n_region"]]:
    """The `most` grains nearest to a random one, in every graph.

    Args:
        pos: grain centres, m.
        batch: graph of each grain, sorted.
        most: grains of a graph that are taken, at least 1.
        halo_m: width of the margin around them.
        randoms: draw the centres, one for each graph.

    Returns:
        The grains taken, and, sorted, those with the margin.
    """
    cores, regions = [batch.new_empty(0)], [batch.new_empty(0)]
    for graph in batch.unique():
        grains = (batch == graph).nonzero().flatten()
        centre = pos[grains[torch.randint(len(grains), (), generator=randoms[int(graph)])]]
        distance = torch.linalg.vector_norm(pos[grains] - centre, dim=1)
        radius = distance.kthvalue(min(most, len(grains))).values
        cores.append(grains[distance <= radius])
        regions.append(grains[distance <= radius + halo_m])
    return torch.cat(cores), torch.cat(regions)

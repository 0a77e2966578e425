"""What an update makes smaller: each grain's error, and what the errors of grains that move together add up to.

Of the motions that can follow a state, a network trained on each grain's error learns an average, and an average moves
less than what it is an average of: |E v|^2 <= E |v|^2 (Jensen). A step by step loss of speed and fluctuation is the
result, and the better-known part of the error does not show it. So cells of grains, small against the flow and large
against a collision (coarse graining: Goldhirsch 2010), must also keep, on average, the DEM's momentum and energy;
larger ones too, whose means scatter less: in small cells an error that a whole bed shares drowns.

A heap creeps with a thousandth of the flow's energy, and what a step lacks of that shows after many only, as each
begins where the last one ended. So cells of slow grains must also, over their own speed, have moved as far as the DEM's
after several steps. Their contacts overlap by micrometres, which an error on the scale of the flow does not show: a bed
may creep as it should and not touch, unless its gaps must stay the DEM's.
"""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch import distributed as dist

FEWEST, SLOWEST = 100, 0.01  # grains of a class, and speed over the velocity scale, below which an error is but chance
CLASSES = (0.2, 0.6, 2.0, 6.0)  # upper limits of classes of mean speed, over what a grain gains in free flight's frame
NEAR, BARE = 0.03, 0.05  # gap in radii of pairs that may touch soon; what counts as left where the DEM's gaps stay
CREEP_CELLS = ((8.0, 1.0), (17.6, 3.0), (35.0, 60.0))  # as CELLS
CELLS = ((8.0, 1.0), (17.6, 10.0))  # edge in radii, weight: 30 and 300 grains of a dense bed; scatter weighs alike


def mean_loss(error: Float[Tensor, "n d"], knee: float) -> Float[Tensor, ""]:
    """Mean square of `error`, or, with a knee, the mean of sqrt(|e|^2 + knee^2) - knee over its groups e of three (the
    pseudo-Huber loss, Charbonnier et al. 1997); 0 where there is none."""
    if not knee:
        return error.square().sum() / max(error.numel(), 1)
    squares = error.view(len(error), error.shape[1] // 3, 3).square().sum(2)
    return _pseudo_huber(squares, knee).sum() / max(squares.numel(), 1)


def balance_loss(error: Float[Tensor, "n 3"], vel: Float[Tensor, "n 3"], cell: Int[Tensor, " n"]) -> Float[Tensor, ""]:
    """How far cells are from the DEM's balance: the squares of their mean errors of momentum and of kinetic energy,
    mean over grains; 0 where there is none.

    Args:
        error: of end velocities, over a scale of velocity.
        vel: the DEM's, over the same scale.
        cell: of each grain; numbers without gaps, as of `cells`.
    """
    energy = (error * (vel + error / 2)).sum(1, keepdim=True)  # (v + e)^2 / 2 - v^2 / 2
    rows = torch.cat([error, energy], dim=1)
    count = torch.bincount(cell)
    total = rows.new_zeros(len(count), 4).index_add_(0, cell, rows)
    return (total.square().sum(1) / count).sum() / max(len(rows), 1)


def creep_loss(
    error: Float[Tensor, "n 3"], vel: Float[Tensor, "n 3"], kind: Int[Tensor, " n"], cell: Int[Tensor, " n"]
) -> Float[Tensor, ""]:
    """How far from where the DEM's are cells have gone on average, for each class of grains by itself and over its own
    mean square way: the slower counts as much as the faster; summed over classes.

    Args:
        error: of mean velocities, over a scale of velocity.
        vel: the DEM's, over the same scale.
        kind: class of each grain; classes of fewer than FEWEST are left out.
        cell: of each grain, as of `cells`.
    """
    total = error.new_zeros(())
    for own, n in _classes(kind):
        number = torch.unique(cell[own], return_inverse=True)[1]
        count = torch.bincount(number)
        gained = error.new_zeros(len(count), 3).index_add(0, number, error[own])
        square = vel[own].square().sum() / n + SLOWEST**2
        total = total + (gained.square().sum(1) / count).sum() / n / square
    return total


def gap_loss(error: Float[Tensor, " p"], way: Float[Tensor, " p"], kind: Int[Tensor, " p"]) -> Float[Tensor, ""]:
    """How far gaps are from the DEM's, over how far they would be had they stayed as they were, for each class of pairs
    by itself; summed over classes. Of both, sqrt(x^2 + 1) - 1 counts: who is far apart by chance does not rule.

    Args:
        error: of gaps, over a scale that overlaps have.
        way: how the DEM's have changed, over the same scale.
        kind: class of each pair; classes of fewer than FEWEST are left out.
    """
    total = error.new_zeros(())
    for own, n in _classes(kind):
        wrong, stayed = (_pseudo_huber(x[own].square(), 1.0).sum() for x in (error, way))
        total = total + wrong / (stayed + BARE * n)
    return total


def _classes(kind: Int[Tensor, " n"]) -> Iterator[tuple[Bool[Tensor, " n"], int]]:
    """Who is of each class, and how many they are; classes of fewer than FEWEST are left out."""
    for known in kind.unique():
        own = kind == known
        n = int(own.sum())
        if n >= FEWEST:
            yield own, n


def _pseudo_huber(squares: Tensor, knee: float) -> Tensor:
    return (squares + knee**2).sqrt() - knee


def cells(
    pos: Float[Tensor, "n 3"], batch: Int[Tensor, " n"], size_m: float, randoms: Sequence[torch.Generator]
) -> Int[Tensor, " n"]:
    """The cell of each grain: cubes of edge `size_m`, laid in each graph at a place drawn from its generator."""
    offset = torch.stack([torch.rand(3, dtype=pos.dtype, generator=random) for random in randoms]).to(pos.device)
    place = torch.floor(pos / size_m + offset[batch]).long()
    return torch.unique(torch.cat([batch[:, None], place], dim=1), dim=0, return_inverse=True)[1]


def share_of_mean(rows: int, device: torch.device) -> float:
    """What a process's mean over `rows` must be multiplied by, so that the mean over processes, which is what their
    gradients are, is the mean over the rows of all: rows / (mean rows of a process)."""
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return 1.0
    total = torch.tensor(float(rows), device=device)
    dist.all_reduce(total)
    return rows * dist.get_world_size() / max(float(total), 1.0)

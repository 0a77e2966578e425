"""How widely what contacts give scatters, and a draw from it.

A frame shows neither how two grains in touch swing nor where exactly they hit. The answer that errs least is then an
average, and an average moves less than what it is an average of (Jensen): grains of a heap stop trembling, friction
holds it, and it rests too steep (docs/balance.md). So each contact also says how widely its answer scatters, and a
roll-out adds impulses as wide, equal and opposite.

Nothing is random: what is drawn is a hash of where the two sides are (SplitMix64: Steele, Lea and Flood 2014). The same
state is followed by the same state, in tiles, in a batch or in a captured graph; states a micrometre apart draw anew.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

FLOOR = 1e-8  # variance of an end velocity that is taken for granted, over the square of the velocity scale
# SplitMix64's increment and factors, as signed numbers
STEP, FACTORS = -0x61C8864680B583EB, ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15))


@dataclass(frozen=True)
class Scatter:
    """How widely the impulses of one kind of contact scatter.

    Attributes:
        sides: their grains: receiver, between grains then sender.
        normal: unit normals, from the receiver to the other side.
        width: standard deviations along the normal and, beside it, in every direction, of the change of an end
            velocity, over the velocity scale.
        share: of sides, see `Contacts.share`, in the order of `sides`.
    """

    sides: tuple[Int[Tensor, " e"], ...]
    normal: Float[Tensor, "e 3"]
    width: Float[Tensor, "e 2"]
    share: tuple[Float[Tensor, "e 1"], ...] | None


def covariance(n: int, kinds: Sequence[Scatter]) -> Float[Tensor, "n 3 3"]:
    """Of the end velocities of `n` grains, over the square of the velocity scale."""
    total = FLOOR * torch.eye(3).to(kinds[0].normal).expand(n, 3, 3)
    for kind in kinds:
        along, anywhere = kind.width.square()[:, :, None, None].unbind(1)
        each = along * kind.normal[:, :, None] * kind.normal[:, None] + anywhere * torch.eye(3).to(kind.normal)
        for number, side in enumerate(kind.sides):
            own = each if kind.share is None else each * kind.share[number][:, :, None].square()
            total = total.index_add(0, side, own)
    return total


def drawn_changes(
    pos: Float[Tensor, "n 3"], kinds: Sequence[Scatter], places: Sequence[Tensor]
) -> Float[Tensor, "n 3"]:
    """Changes of end velocities, over the velocity scale, drawn for grains at `pos`, m; `places` are where the other
    sides are."""
    total, grains = kinds[0].normal.new_zeros(len(pos), 3), hashed(pos.detach())
    for kind, place in zip(kinds, places, strict=True):
        own, other = grains[kind.sides[0]], hashed(place.detach())
        number = normals(own + other).to(kind.normal)
        turn = torch.where(own < other, 1.0, -1.0).to(kind.normal)[:, None]  # the same from either side
        given = kind.width[:, :1] * number[:, :1] * kind.normal + kind.width[:, 1:] * turn * number[:, 1:]
        for side, (rows, sign) in enumerate(zip(kind.sides, (1, -1), strict=False)):
            own_given = given if kind.share is None else given * kind.share[side]
            total = total.index_add(0, rows, sign * own_given)
    return total


def hashed(pos: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """A number of 64 bits for each place; float64."""
    bits = pos.contiguous().view(torch.int64)
    key = torch.zeros_like(bits[:, 0])
    for column in bits.unbind(1):
        key = mixed(key + column)
    return key


def normals(key: Int[Tensor, " e"]) -> Float[Tensor, "e 4"]:
    """Four standard normal numbers of each key (Box and Muller 1958)."""
    first = mixed(key + STEP)
    second = mixed(first + STEP)
    low, high = (torch.stack([bits & 0xFFFFFFFF, (bits >> 32) & 0xFFFFFFFF], 1) for bits in (first, second))
    length = (-2 * ((low.double() + 1) / 2**32).log()).sqrt()
    angle = 2 * math.pi * high.double() / 2**32
    return torch.cat([length * angle.cos(), length * angle.sin()], dim=1)


def mixed(bits: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """SplitMix64's finaliser, a bijection."""
    for shift, factor in FACTORS:
        bits = (bits ^ _shifted(bits, shift)) * factor
    return bits ^ _shifted(bits, 31)


def _shifted(bits: Int[Tensor, " n"], by: int) -> Int[Tensor, " n"]:
    return (bits >> by) & ((1 << (64 - by)) - 1)  # zeros come in, not the sign

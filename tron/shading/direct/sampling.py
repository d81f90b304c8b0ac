"""Sample points of an image: one scrambled Sobol sequence, handed out to the pixels in Z order.

The first two dimensions of Sobol's sequence are a (0, 2)-sequence: of any aligned run of 2^k points, every
dyadic rectangle of area 2^-k holds exactly one (Sobol 1967). A pixel takes such a run, so its points are
stratified in every way at once. The four pixels of a block, the sixteen of the next larger one, and so on
take consecutive runs, so neighbours divide the strata and their errors differ in sign: noise moves to high
frequencies, where a filter and the eye remove it (Ahmed and Wonka 2020, "Screen-Space Blue-Noise Diffusion of
Monte Carlo Sampling Error via Hierarchical Ordering of Pixels"). Owen scrambling (Laine and Karras 2011;
Burley 2020, "Practical Hash-based Owen Scrambling") makes every point uniform by itself, so estimates are
unbiased, and keeps all of that structure; it also shuffles the Z order.

Within a pixel the points come in the order of their strata, the same for all pixels: neighbouring lanes then
send rays in neighbouring directions, and so do four consecutive points of one lane. All of this holds for 2^k
points per pixel; for other counts the points are simply the next in the sequence, and merely well spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.seeds import integer

BLOCK_BITS = 6
"""Pixels are in Z order within blocks of 2^6 squared; blocks follow each other row by row."""
_PASCAL = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))
# The multipliers of Burley 2020; each product is even, so that a bit depends on the bits below it alone.
_MULTIPLIERS = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


def pascal(index: Any) -> Any:
    """Bits of ``index`` times Pascal's triangle modulo 2: the second dimension of Sobol, bit-reversed.

    Entry (j, k), the binomial k over j, is odd where the bits of j are among those of k, so the product is a
    sum over supersets: five steps instead of 32 (Ahmed 2024). NumPy or Dr.Jit uint32.
    """
    for step, mask in _PASCAL:
        index = index ^ ((index >> step) & mask)
    return index


def scramble(bits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Permute the nodes of the binary tree of all words, lowest bit first: Owen scrambling, bit-reversed."""
    bits = bits + seed
    for multiplier in _MULTIPLIERS:
        bits = bits ^ (bits * mi.UInt32(multiplier))
    return bits


def morton(x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
    """Interleave the lowest 16 bits of x and y."""

    def spread(v: mi.UInt32) -> mi.UInt32:
        v = (v | (v << 8)) & 0x00FF00FF
        v = (v | (v << 4)) & 0x0F0F0F0F
        v = (v | (v << 2)) & 0x33333333
        return (v | (v << 1)) & 0x55555555

    return spread(x & 0xFFFF) | (spread(y & 0xFFFF) << 1)


def has_strata(count: int) -> bool:
    """Whether runs of ``count`` points are stratified: ``count`` is a power of two."""
    return count & (count - 1) == 0


@cache
def stratum_order(log_count: int) -> np.ndarray:
    """Indices, within the first run of 2^log_count points, in Z order of the points' strata; (2^log_count,).

    Strata are 2^a columns by 2^b rows, a + b = log_count, b the larger by at most one.
    """
    columns, rows = log_count // 2, log_count - log_count // 2
    index = np.arange(1 << log_count, dtype=np.uint32)
    column, row = index & ((1 << columns) - 1), pascal(index) & ((1 << rows) - 1)
    # First digits are the highest bits of a stratum's place, and lie lowest in a bit-reversed word.
    key = np.zeros_like(index)
    for digit in range(rows):
        level = 2 * (rows - 1 - digit)
        key |= ((row >> digit) & 1) << level
        if digit < columns:
            key |= ((column >> digit) & 1) << (level + 1)
    return index[np.argsort(key, kind="stable")]


@cache
def row_shift(log_count: int) -> np.ndarray:
    """Bits to flip in a pixel's own indices so that rows begin at the first: (2^rows,) by the run's own rows.

    Rows of the run that begins at ``first`` are those of the first run, exclusive-or ``pascal(first)``. The
    map from indices to strata is linear, so the same exclusive-or undoes it for every index.
    """
    columns, rows = log_count // 2, log_count - log_count // 2
    index = np.arange(1 << log_count, dtype=np.uint32)
    column, row = index & ((1 << columns) - 1), pascal(index) & ((1 << rows) - 1)
    shift = np.zeros(1 << rows, np.uint32)
    shift[row[column == 0]] = index[column == 0]
    return shift


@dataclass
class PixelPoints:
    """``count`` points in [0, 1)^2 for every pixel of an image, in several sets scrambled independently.

    Attributes:
        count: points a pixel, in each set.
        order: indices within a pixel's run of points, in order of use: by strata if ``count`` is a power of
            two; otherwise empty, and the sequence is used in its own order.
        shift: see :func:`row_shift`; zero without strata.
        row_mask: mask of the bits that index ``shift``.
        seeds: of the pixels' order, then of columns and rows of each set.
        width, across: pixels and blocks across the image.
    """

    count: int
    order: mi.UInt32
    shift: mi.UInt32
    row_mask: mi.UInt32
    seeds: mi.UInt32
    width: mi.UInt32
    across: mi.UInt32

    @classmethod
    def make(cls, count: int, sets: int, width: int, seed: int, *path: str | int) -> PixelPoints:
        """Points of an image ``width`` pixels across; seed and path as in :func:`tron.seeds.integer`."""
        order, shift = np.arange(count, dtype=np.uint32), np.zeros(1, np.uint32)
        if has_strata(count):
            log_count = count.bit_length() - 1
            order, shift = stratum_order(log_count), row_shift(log_count)
        return cls(
            count=count,
            order=mi.UInt32(order),
            shift=mi.UInt32(shift),
            row_mask=dr.opaque(mi.UInt32, len(shift) - 1),
            seeds=mi.UInt32([integer(seed, *path, "points", i) for i in range(1 + 2 * sets)]),
            width=dr.opaque(mi.UInt32, width),
            across=dr.opaque(mi.UInt32, (width >> BLOCK_BITS) + 1),
        )

    @property
    def fan(self) -> int:
        """Number of consecutive points, in an eighth of the unit square, whose rays are traced together."""
        return next(k for k in (4, 2, 1) if (has_strata(self.count) and self.count >= 8 * k) or k == 1)

    def run(self, pixel: mi.UInt32) -> mi.UInt32:
        """First index of the run of ``pixel`` (row-major)."""
        x, y = pixel % self.width, pixel // self.width
        low = (1 << BLOCK_BITS) - 1
        block = (y >> BLOCK_BITS) * self.across + (x >> BLOCK_BITS)
        rank = (block << (2 * BLOCK_BITS)) | morton(x & low, y & low)
        # From the highest bit down: blocks of pixels of every size stay together.
        rank = dr.brev(scramble(dr.brev(rank), dr.gather(mi.UInt32, self.seeds, 0)))
        # Runs follow each other without gaps: a point that no pixel takes would leave a hole in the strata.
        return rank * dr.opaque(mi.UInt32, self.count)

    def point(self, run: mi.UInt32, i: mi.UInt32, which: mi.UInt32) -> mi.Point2f:
        """Point ``i`` of 0..count-1 of the set ``which``, of the pixel whose run begins at ``run``."""
        own = dr.gather(mi.UInt32, self.shift, pascal(run) & self.row_mask)
        index = run + (dr.gather(mi.UInt32, self.order, i) ^ own)
        column = scramble(index, dr.gather(mi.UInt32, self.seeds, 2 * which + 1))
        row = scramble(pascal(index), dr.gather(mi.UInt32, self.seeds, 2 * which + 2))
        # 24 bits are what a float32 below one can hold.
        return mi.Point2f(mi.Float(dr.brev(column) >> 8), mi.Float(dr.brev(row) >> 8)) * float(2.0**-24)

"""A bounding volume hierarchy for arbitrary rays: perfectly balanced, threaded with skip links, no stack.

Built by median splits of the longest axis, level by level, all nodes of a level at once. The tree is
perfect, so nodes in depth-first order follow from arithmetic: a node's left child is the next one, and
its skip link (where to go when the box is missed, or after a leaf) is itself plus the size of its
subtree. A node is four 32-bit words: six 16-bit bounds on a grid over the scene, rounded outwards, and
the skip link or leaf word. Four words are one packet; float bounds took 2.7 times as long (tracer.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

LEAF_SIZE = 2
LEAF_BIT = 1 << 31
_GRID = 65533


@dataclass
class Bvh:
    """The hierarchy and its surfels, uploaded.

    Attributes:
        nodes: mi.UInt32, 4 words a node in depth-first order: (low | high << 16) for x, y, z, and the link.
            The link of an inner node is the node to skip to; of a leaf, ``LEAF_BIT | first << 4 | count``.
        node_count: opaque mi.UInt32 of one lane, so that scenes of any size share one kernel.
        geometry: mi.Float, geometry records in leaf order.
        order: (M,) int64, leaf order -> scene order.
        grid_origin, grid_scale: opaque; world -> grid coordinates.
        degree: kernel degree.
    """

    nodes: mi.UInt32
    node_count: mi.UInt32
    geometry: mi.Float
    order: np.ndarray
    grid_origin: mi.Point3f
    grid_scale: mi.Vector3f
    degree: int


def surfel_bounds(geometry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tight axis-aligned boxes of the cut disks of (M, 12) geometry records, two (M, 3) float64 arrays."""
    axis_u, axis_v = geometry[:, 4:7].astype(np.float64), geometry[:, 8:11].astype(np.float64)
    reach = np.sqrt(np.maximum(geometry[:, 11:12].astype(np.float64), 0.0))
    half_u = axis_u / np.maximum((axis_u**2).sum(1, keepdims=True), 1e-30) * reach
    half_v = axis_v / np.maximum((axis_v**2).sum(1, keepdims=True), 1e-30) * reach
    extent = np.sqrt(half_u**2 + half_v**2)
    centre = geometry[:, 0:3].astype(np.float64)
    return centre - extent, centre + extent


def median_order(centres: np.ndarray, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Order points by ``levels`` rounds of median splits of the longest axis.

    Returns:
        (M,) int64 order and (2^levels,) int64 count of points in each leaf.
    """
    order = np.arange(len(centres))
    counts = np.array([len(centres)])
    for _ in range(levels):
        starts = np.cumsum(counts) - counts
        sorted_centres = centres[order]
        low = np.minimum.reduceat(sorted_centres, starts)
        high = np.maximum.reduceat(sorted_centres, starts)
        segment = np.repeat(np.arange(len(counts)), counts)
        key = sorted_centres[np.arange(len(order)), np.argmax(high - low, 1)[segment]]
        order = order[np.lexsort((key, segment))]
        left = (counts + 1) // 2
        counts = np.stack([left, counts - left], 1).ravel()
    return order, counts


def _depth_first(levels: int) -> list[np.ndarray]:
    """Depth-first index of each node of a perfect tree, level by level from the root."""
    indices = [np.zeros(1, np.int64)]
    for level in range(levels):
        parent = indices[-1]
        right = parent + (1 << (levels - level))  # past the left subtree of 2^(levels - level) - 1 nodes
        indices.append(np.stack([parent + 1, right], 1).ravel())
    return indices


def build_bvh(geometry: np.ndarray, degree: int) -> Bvh:
    """Build and upload the hierarchy of (M, 12) float32 geometry records (M may be 0)."""
    geometry = geometry[geometry[:, 11] >= 0]  # surfels too faint to count anywhere
    count = len(geometry)
    if count == 0:
        empty = np.array([0, 0, 0, LEAF_BIT], np.uint32)
        return _upload(
            empty, np.zeros(12, np.float32), np.zeros(0, np.int64), np.zeros(3), np.ones(3), degree
        )
    low, high = surfel_bounds(geometry)
    levels = max(0, int(np.ceil(np.log2(count / LEAF_SIZE))))
    order, counts = median_order((low + high) / 2, levels)
    starts = np.cumsum(counts) - counts

    grid_low, grid_high = low.min(0), high.max(0)
    pad = 1e-4 * max(float((grid_high - grid_low).max()), 1e-6)
    grid_low, grid_high = grid_low - pad, grid_high + pad
    scale = _GRID / (grid_high - grid_low)

    box_low, box_high = np.minimum.reduceat(low[order], starts), np.maximum.reduceat(high[order], starts)
    words = np.zeros(((2 << levels) - 1, 4), np.uint32)
    indices = _depth_first(levels)
    for level in range(levels, -1, -1):
        index = indices[level]
        # One cell of slack on each side covers the float32 rounding of the rays' grid coordinates.
        q_low = np.clip(np.floor((box_low - grid_low) * scale) - 1, 0, 65535).astype(np.uint32)
        q_high = np.clip(np.ceil((box_high - grid_low) * scale) + 1, 0, 65535).astype(np.uint32)
        words[index, :3] = q_low | (q_high << 16)
        if level == levels:
            words[index, 3] = (LEAF_BIT | (starts << 4) | counts).astype(np.uint32)
        else:
            words[index, 3] = (index + (2 << (levels - level)) - 1).astype(np.uint32)
        box_low = np.minimum(box_low[0::2], box_low[1::2]) if level else box_low
        box_high = np.maximum(box_high[0::2], box_high[1::2]) if level else box_high
    return _upload(words.ravel(), geometry[order].ravel(), order, grid_low, scale, degree)


def _upload(
    words: np.ndarray,
    geometry: np.ndarray,
    order: np.ndarray,
    origin: np.ndarray,
    scale: np.ndarray,
    degree: int,
) -> Bvh:
    grid_origin, grid_scale = mi.Point3f([float(v) for v in origin]), mi.Vector3f([float(v) for v in scale])
    dr.make_opaque(grid_origin, grid_scale)
    bvh = Bvh(
        mi.UInt32(words),
        dr.opaque(mi.UInt32, len(words) // 4),
        mi.Float(geometry),
        order,
        grid_origin,
        grid_scale,
        degree,
    )
    dr.eval(bvh.nodes, bvh.geometry)
    return bvh

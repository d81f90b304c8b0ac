"""The gradient of compositing: the stored hits of each ray are replayed with one running scalar.

With ``g`` the gradient of the sums ``F = sum_i w_i f_i`` and ``g_T`` the gradient of the final T, let

    rest_i = sum_{j > i} w_j (g . f_j) + g_T T

Then, for hit i with ``w_i = T_i alpha_i``:

    d/df_i = w_i g,    d/dalpha_i = T_i (g . f_i) - rest_i / (1 - alpha_i)

Front to back, ``rest`` starts as ``g . F + g_T T`` and loses ``w_i (g . f_i)`` at each hit, so neither a
second list nor a backward walk is needed. Which surfels are hit, and the median, are not differentiated;
where alpha is clipped its derivative is zero.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from tron.gaussians.harmonics import sh_basis
from tron.tracing.compositing import CHANNELS, MATERIAL_PACKETS, Composite, HitList, harmonic_sums
from tron.tracing.kernel import (
    FEATURE_PACKETS,
    GEOMETRY_PACKETS,
    MAX_ALPHA,
    SH_PACKETS,
    Filtered,
    SurfelHit,
    SurfelRecords,
    intersect,
    log_response_slope,
    value_packets,
)
from tron.tracing.tiled.kbuffer import lanes_of

COPIED_BYTES = 1 << 30
"""Most memory for the copies into which threads add the gradients of one kind of record."""
_RECORDS = ("geometry", "features", "harmonics", "values")


@dataclass
class _Gradients:
    """Sums of gradients in the layout of the records; None for records that need none."""

    geometry: mi.Float | None
    features: mi.Float | None
    harmonics: mi.Float | None
    values: mi.Float | None


@dataclass
class _Replay:
    """What the adjoint needs of the forward pass, detached."""

    records: SurfelRecords
    origin: mi.Point3f
    direction: mi.Vector3f
    hits: list[Iterable[HitList]]
    sums: Composite
    wanted: tuple[str, ...]
    differentiate_basis: bool


def has_gradients(records: SurfelRecords, direction: mi.Vector3f) -> bool:
    """Whether the records or ``direction`` have gradients enabled."""
    view = records.sh_degree > 0 and dr.grad_enabled(direction)
    return view or any(_differentiable(records, name) for name in _RECORDS)


def _differentiable(records: SurfelRecords, name: str) -> bool:
    return dr.grad_enabled(getattr(records, name))


def attach(
    sums: Composite,
    records: SurfelRecords,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    hits: list[Iterable[HitList]],
) -> Composite:
    """Attach derivatives by the records and SH's view direction to sums traced without gradients.

    Does nothing, at no cost, if neither ``records`` nor ``direction`` have gradients. The direction is
    differentiated in the radiance only; the rays themselves are constant.

    Args:
        sums: of each ray, evaluated. records: the surfels that were traced.
        origin, direction: the rays. hits: the rays' hit lists, one list per ray, read by each backward pass.
    """
    if not has_gradients(records, direction):
        return sums
    view = dr.grad_enabled(direction)
    wanted = tuple(name for name in _RECORDS if _differentiable(records, name))
    basis = sh_basis(direction.x, direction.y, direction.z)[1:] if records.sh_degree > 0 else []
    replay = _Replay(records.detached(), dr.detach(origin), dr.detach(direction), hits, sums, wanted, view)
    channels, mean_depth, transmittance = dr.custom(
        _Compositing, records.geometry, records.features, records.harmonics, records.values, basis, replay
    )
    return replace(sums, channels=channels, mean_depth=mean_depth, transmittance=transmittance)


class _Compositing(dr.CustomOp):
    """Records and the non-constant SH basis -> (channels, mean depth, transmittance)."""

    def eval(self, geometry: Any, features: Any, harmonics: Any, values: Any, basis: Any, replay: Any) -> Any:
        del geometry, features, harmonics, values  # their values are in the sums already
        self.basis, self.replay = basis, replay
        sums = self.replay.sums
        return [mi.Float(channel) for channel in sums.channels], sums.mean_depth, sums.transmittance

    def backward(self) -> None:
        replay, records = self.replay, self.replay.records
        channels, mean_depth, transmittance = cast("tuple[Any, Any, Any]", self.grad_out())
        rest = transmittance * replay.sums.transmittance + mean_depth * replay.sums.mean_depth
        for gradient, value in zip(channels, replay.sums.channels, strict=True):
            rest = dr.fma(gradient, value, rest)
        has_gradient = tuple(not _silent(group) for group in _groups(channels))
        dr.eval(channels, mean_depth, rest)
        # Gradients that are not needed, such as those of frozen geometry, cost nothing.
        out = _Gradients(
            **{
                name: dr.zeros(mi.Float, _capacity(dr.width(getattr(records, name))))
                if name in replay.wanted
                else None
                for name in _RECORDS
            }
        )
        by_basis = (
            [dr.zeros(mi.Float, dr.width(rest)) for _ in self.basis] if replay.differentiate_basis else []
        )
        for hits in chain.from_iterable(replay.hits):
            outer = [dr.gather(mi.Float, channel, hits.ray) for channel in channels]
            depth = dr.gather(mi.Float, mean_depth, hits.ray)
            origin, direction = (lanes_of(v, hits.ray) for v in (replay.origin, replay.direction))
            basis = sh_basis(direction.x, direction.y, direction.z)
            added = _replay(
                records, hits, origin, direction, basis, outer, depth,
                dr.gather(mi.Float, rest, hits.ray), out, has_gradient, len(by_basis),
            )  # fmt: skip
            for target, value in zip(by_basis, added, strict=True):
                dr.scatter(target, value, hits.ray, hits.count > 0)
        dr.eval(out, by_basis)
        for name in replay.wanted:
            width = dr.width(getattr(records, name))
            self.set_grad_in(name, dr.reshape(mi.Float, getattr(out, name), width, shrink=True))
        if by_basis:
            self.set_grad_in("basis", by_basis)


def _capacity(numbers: int) -> int:
    """Round ``numbers`` up to a quarter of its octave.

    Dr.Jit compiles the width of an array with per-thread copies into the kernel: fewer widths, fewer kernels.
    """
    step = max(1, (1 << (numbers - 1).bit_length()) >> 3)
    return -(-numbers // step) * step


def _silent(gradients: list[mi.Float]) -> bool:
    """Whether a loss does not use these outputs; their records are then neither read nor added to."""
    return all(g.state == dr.VarState.Literal and g[0] == 0 for g in gradients)


def _groups(channels: list[mi.Float]) -> list[list[mi.Float]]:
    """Channels grouped as in packets: two of materials, radiance, and packets of values."""
    ends = [0, 4, 8, CHANNELS, *range(CHANNELS + 4, len(channels) + 4, 4)]
    return [channels[first:last] for first, last in pairwise(ends)]


def _add(target: mi.Float | None, packet: mi.UInt32, values: list[mi.Float], active: mi.Bool) -> None:
    if target is not None:
        dr.scatter_reduce(
            dr.ReduceOp.Add, target, mi.Vector4f(*values), packet, active, _reduction(dr.width(target))
        )


def _reduction(numbers: int) -> dr.ReduceMode:
    """Mode of adding to ``numbers`` numbers: on CPUs, into a copy per thread, if these fit in memory.

    By default, Dr.Jit stops making copies at a million numbers (the harmonics of 22,000 surfels) and takes
    two to five times as long beyond.
    """
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
        return dr.ReduceMode.Auto
    copies = 4 * numbers * dr.thread_count()
    return dr.ReduceMode.Expand if copies <= COPIED_BYTES else dr.ReduceMode.Direct


@dr.syntax
def _replay(
    records: SurfelRecords, hits: HitList, origin: mi.Point3f, direction: mi.Vector3f, basis: list[mi.Float],
    outer: list[mi.Float], outer_depth: mi.Float, rest: mi.Float, out: _Gradients,
    has_gradient: tuple[bool, ...], functions: int,
) -> list[mi.Float]:  # fmt: skip
    """Walk each list front to back and add its gradients to ``out``.

    Args:
        records, origin, direction, basis: as in the forward pass, one lane a list.
        hits: the lists.
        outer, outer_depth: gradients of the channels and of the mean depth.
        rest: the running scalar of the module docstring.
        out: receives the gradients of the records.
        has_gradient: for each of :func:`_groups`, whether any channel has a gradient.
        functions: number of basis functions, from the second on, to differentiate by.

    Returns:
        Gradients of the basis functions.
    """
    by_basis = [mi.Float(0) for _ in range(functions)]
    lane, lists = dr.arange(mi.UInt32, dr.width(hits.ray)), dr.opaque(mi.UInt32, dr.width(hits.ray))
    remaining, slot = mi.Float(1), mi.UInt32(0)
    active = slot < hits.count
    while active:
        index = dr.gather(mi.UInt32, hits.ids, slot * lists + lane, active)
        hit = intersect(records.geometry, index, origin, direction, records.degree, records.pixel)
        weight = remaining * hit.alpha
        projected = outer_depth * hit.t
        for packet in range(MATERIAL_PACKETS):
            if dr.hint(has_gradient[packet], mode="scalar"):
                at = index * FEATURE_PACKETS + packet
                feature = dr.gather(mi.Vector4f, records.features, at, active)
                gradient = outer[4 * packet : 4 * packet + 4]
                for k in range(4):
                    projected = dr.fma(gradient[k], feature[k], projected)
                _add(out.features, at, [weight * value for value in gradient], active)
        if dr.hint(has_gradient[2], mode="scalar"):
            color, by_basis = _replay_radiance(
                records, index, basis, weight, outer[8:11], by_basis, out, active
            )
            for k in range(3):
                projected = dr.fma(outer[8 + k], color[k], projected)
        for packet, gradient in enumerate(_groups(outer)[3:]):
            if dr.hint(has_gradient[3 + packet], mode="scalar"):
                at = index * value_packets(records.value_count) + packet
                value = dr.gather(mi.Vector4f, records.values, at, active)
                for k in range(len(gradient)):
                    projected = dr.fma(gradient[k], value[k], projected)
                added = [weight * g for g in gradient] + [mi.Float(0)] * (4 - len(gradient))
                _add(out.values, at, added, active)
        rest = dr.fma(-weight, projected, rest)
        by_alpha = remaining * projected - rest / (1 - hit.alpha)
        _replay_hit(records, index, hit, direction, by_alpha, weight * outer_depth, out, active)
        remaining *= 1 - hit.alpha
        slot += 1
        active &= slot < hits.count
    return by_basis


def _replay_radiance(
    records: SurfelRecords, index: mi.UInt32, basis: list[mi.Float], weight: mi.Float, outer: list[mi.Float],
    by_basis: list[mi.Float], out: _Gradients, active: mi.Bool,
) -> tuple[list[mi.Float], list[mi.Float]]:  # fmt: skip
    """Add one surfel's radiance gradients to ``out``; return its radiance and the basis gradients so far."""
    if records.sh_degree == 0:  # packing evaluates and differentiates the clipping
        at = index * FEATURE_PACKETS + MATERIAL_PACKETS
        packed = dr.gather(mi.Vector4f, records.features, at, active)
        _add(out.features, at, [*[weight * value for value in outer], mi.Float(0)], active)
        return [packed[0], packed[1], packed[2]], by_basis
    packets, total = harmonic_sums(records, index, basis, active)
    numbers = 3 * (records.sh_degree + 1) ** 2
    by_total = [dr.select(total[k] > 0, weight * outer[k], 0) for k in range(3)]
    for packet in range(len(packets)):
        values = []
        for number in range(4 * packet, 4 * packet + 4):
            coefficient, channel = divmod(number, 3)
            values.append(by_total[channel] * basis[coefficient] if number < numbers else mi.Float(0))
        _add(out.harmonics, index * SH_PACKETS + packet, values, active)
    if by_basis:
        by_basis = list(by_basis)
        for number in range(3, numbers):
            coefficient, channel = divmod(number, 3)
            by_basis[coefficient - 1] = dr.fma(
                by_total[channel], packets[number // 4][number % 4], by_basis[coefficient - 1]
            )
    return [dr.select(value > 0, value, 0) for value in total], by_basis


def _replay_hit(
    records: SurfelRecords, index: mi.UInt32, hit: SurfelHit, direction: mi.Vector3f,
    by_alpha: mi.Float, by_t: mi.Float, out: _Gradients, active: mi.Bool,
) -> None:  # fmt: skip
    """Gradients of a geometry record from the gradients of alpha and t: ``kernel.intersect`` in reverse.

    t = n . c / (n . d) with n = a x b and c from the origin to the centre; the offset is t d - c.
    """
    by_alpha = dr.select(hit.unclipped < MAX_ALPHA, by_alpha, 0)
    by_q = by_alpha * hit.unclipped * log_response_slope(hit.q, records.degree)
    by_centre = mi.Vector3f(0)
    if hit.filtered is not None:
        by_centre = _by_centre(hit.filtered, records.pixel, direction, by_q, by_t)
        by_t = mi.Float(0)
    by_u, by_v = 2 * hit.u * by_q, 2 * hit.v * by_q
    by_offset = by_u * hit.u_axis + by_v * hit.v_axis
    along = (by_t + dr.dot(by_offset, direction)) / hit.facing
    by_normal = -along * hit.offset
    by_centre += along * hit.normal - by_offset
    by_a = by_u * hit.offset + dr.cross(hit.v_axis, by_normal)
    by_b = by_v * hit.offset + dr.cross(by_normal, hit.u_axis)
    base = index * GEOMETRY_PACKETS
    _add(out.geometry, base, [*by_centre, by_alpha * hit.response], active)
    _add(out.geometry, base + 1, [*by_a, mi.Float(0)], active)
    _add(out.geometry, base + 2, [*by_b, mi.Float(0)], active)


def _by_centre(
    filtered: Filtered, pixel: mi.Vector3f, direction: mi.Vector3f, by_q: mi.Float, by_t: mi.Float
) -> mi.Vector3f:
    """Gradient of a centre c from the gradients of q and t, where the pixel's filter is what is hit.

    With z = pixel . c, e = d / (pixel . d) and g = e - c / z, q = g^2 and t = z / (pixel . d).
    """
    aside, ray = filtered.aside, filtered.slope * direction
    by_q = dr.select(filtered.larger, 2 * by_q / filtered.depth, 0)
    return (by_t * filtered.slope + by_q * dr.dot(aside, ray - aside)) * pixel - by_q * aside

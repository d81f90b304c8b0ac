"""Priors and their maps on the views of a capture.

A prior says what it can give for a capture and how it comes by it, and gives that and nothing else: a field
that it lacks stays None on the views, so that whoever needs it says so, rather than learn from an invention.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from pydantic import ConfigDict

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.errors import TronError

FIELDS = ("normal", "base_color", "roughness", "metallic", "irradiance", "sky_mask")
"""The fields of :class:`tron.captures.View` that priors fill; spaces and frames are stated there."""

GBuffers = Callable[[View], Mapping[str, np.ndarray]]
"""What the reconstructed surfels show from a view: ``tracer.gbuffer(view.camera).numpy()``, of which priors
read ``normal`` (H, W, 3) world, ``depth`` (H, W) and ``opacity`` (H, W)."""

Maps = Callable[[View], Mapping[str, Pixels]]
"""The maps of one view: field -> array, or what reads the array when it is asked for."""

CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Of the pydantic dataclasses that priors are: values outside of their range are refused when one is made."""

Track = Callable[[Iterable, str], Iterable]
"""Wraps long loops as ``track(items, label)``, such as :func:`tron.cli.progress.track`."""


def untracked(items: Iterable, _label: str) -> Iterable:
    """The items, without any word of how far the work on them has come."""
    return items


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request:
    """Maps that a prior is asked for.

    Attributes:
        capture: all its views are offered; only the training views are asked for maps afterwards.
        fields: wanted; a subset of what the prior offers, without those that lack their geometry.
        gbuffers: the reconstructed geometry, or None before there is any.
        track: wraps loops over views.
    """

    capture: Capture
    fields: frozenset[str]
    gbuffers: GBuffers | None
    track: Track


class Prior(Protocol):
    """Source of per-view maps; a frozen dataclass of plain values, for Hydra's ``_target_``."""

    @property
    def needs_geometry(self) -> frozenset[str]:
        """The fields that can be given only once surfels are reconstructed."""
        ...

    def fields(self, capture: Capture) -> Mapping[str, str]:
        """Maps that can be given for this capture, geometry supposed: field -> how, in a few words.

        Raises:
            TronError: nothing can be given, for example because a folder or a checkpoint is missing.
        """
        ...

    def prepare(self, request: Request) -> Maps:
        """Load or fit what all views share, and return what makes the maps of one view.

        The maps hold the wanted fields at most, in the spaces that View states, and lack what this view has
        not got.
        """
        ...


def apply_prior(
    capture: Capture,
    prior: Prior,
    fields: Collection[str] | None = None,
    gbuffers: GBuffers | None = None,
    track: Track = untracked,
) -> Capture:
    """A capture whose training views carry the maps of a prior, and of no one else.

    The fields asked for are overwritten, with None where the prior has nothing: maps of two sources are never
    mixed. Held-out views keep what they have, the truth by which they are judged. Arrays are kept in half
    precision (8 bits for masks), readers are kept as they are. What is given and what is not is logged.

    Args:
        capture: its training views get the maps.
        prior: whose maps.
        fields: of ``FIELDS``, those to fill now; None for all.
        gbuffers: the reconstructed geometry, where there is some already; fields that need it are left out
            without.
        track: shows the progress of long loops.

    Raises:
        TronError: an unknown field, or what the prior raises.
    """
    wanted = FIELDS if fields is None else tuple(fields)
    unknown = sorted(set(wanted) - set(FIELDS))
    if unknown:
        raise TronError(f"{unknown[0]!r} is no field of a prior", mend=f"use {', '.join(FIELDS)}")
    name = type(prior).__name__
    offered = prior.fields(capture)
    reasons = {field: f"not available from {name}" for field in wanted if field not in offered}
    if gbuffers is None:
        waiting = [field for field in wanted if field in offered and field in prior.needs_geometry]
        reasons |= dict.fromkeys(waiting, "not before the geometry is reconstructed")
    given = [field for field in wanted if field not in reasons]
    for field in wanted:
        log.info("prior %s: %s: %s", name, field, reasons.get(field) or offered[field])
    found: dict[str, Mapping[str, Pixels]] = {}
    if given:
        maps = prior.prepare(Request(capture, frozenset(given), gbuffers, track))
        for view in track(capture.train_views, f"prior {name}"):
            found[view.name] = maps(view)
    _report_gaps(name, given, found)
    views = tuple(_carrying(view, wanted, found, capture.test) for view in capture.views)
    return replace(capture, views=views)


def _carrying(
    view: View, wanted: Collection[str], found: Mapping[str, Mapping[str, Pixels]], test: frozenset[str]
) -> View:
    if view.name in test:
        return view
    maps = found.get(view.name, {})
    # Arrays are checked by a View of their own before they are packed; readers when they read.
    checked = replace(view, **{field: maps.get(field) for field in wanted})
    packed: dict[str, Any] = {
        field: _packed(field, checked.read(field))
        for field, value in maps.items()
        if field in wanted and not callable(value)
    }
    return replace(checked, **packed) if packed else checked


def _packed(field: str, pixels: np.ndarray) -> Callable[[], np.ndarray]:
    """Hold a map in half precision, or 8 bits, until it is read; half's relative error is 5e-4."""
    if field == "sky_mask":
        return partial(_unpacked, np.round(255 * pixels.clip(0, 1)).astype(np.uint8), 255)
    limit = float(np.finfo(np.float16).max)
    return partial(_unpacked, pixels.clip(-limit, limit).astype(np.float16), 1)


def _unpacked(pixels: np.ndarray, scale: int) -> np.ndarray:
    return pixels.astype(np.float32) / scale


def _report_gaps(name: str, given: Collection[str], found: Mapping[str, Mapping[str, Pixels]]) -> None:
    for field in given:
        without = [view for view, maps in found.items() if field not in maps]
        if without:
            gap = f"missing for {len(without)} of {len(found)} views (first: {without[0]})"
            log.warning("prior %s: %s: %s", name, field, gap)

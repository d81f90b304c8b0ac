"""Captures under lights that their photos never saw: where the path-traced truth of each lies.

``captured.relit=FOLDER`` is the folder ``relit`` of pseudo-captures: a capture folder for each capture and
light, ``NAME_1_sun``, with linear radiance, masks and the light itself as environment.exr. ``captured.truth``
is their folder ``truth``, whose maps of base color tell the scale of the reconstruction's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from datagen.settings import Settings
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.errors import TronError

ENVIRONMENT_NAME = "environment.exr"
MEND = "give the folder truth of pseudo-captures"
_LIGHT = re.compile(r"([1-9][0-9]{0,3})_([a-z][a-z0-9_]{0,30})")


@dataclass(frozen=True)
class RelitTruth:
    """A capture's views under one other light.

    Attributes:
        folder: a capture folder, linear, with masks.
        number: of the light among the capture's, from 1.
        family: of the light.
        views: how many there are.
    """

    folder: Path
    number: int
    family: str
    views: int

    @property
    def environment(self) -> Path:
        """The light, a lat-long map."""
        return self.folder / ENVIRONMENT_NAME


def find_relit(settings: Settings, capture: str) -> list[RelitTruth]:
    """A capture's views under other lights, in the order of the lights; none without ``captured.relit``.

    Raises:
        TronError: no such folder, nothing of this capture in it, a folder without its light or without
            views, or fewer views than a clip has frames.
    """
    folder = settings.captured.relit
    if folder is None:
        return []
    if not folder.is_dir():
        raise TronError("captured.relit is no folder", folder, "give the folder relit of pseudo-captures")
    found = []
    for path in sorted(folder.glob(f"{escape(capture)}_*")):
        light = _LIGHT.fullmatch(path.name.removeprefix(f"{capture}_"))
        if light is not None and path.is_dir():
            found.append(RelitTruth(path, int(light[1]), light[2], _views(path, settings)))
    if not found:
        raise TronError(
            f"captured.relit holds nothing of the capture {capture}",
            folder,
            "give the relit folder that was made with these captures, or name those it has: "
            "captured.names=[...]",
        )
    return sorted(found, key=lambda truth: truth.number)


def find_truth(settings: Settings, capture: str) -> list[View]:
    """True views of a capture that have a map of their base color; none without ``captured.truth``.

    Raises:
        TronError: no such folder, nothing of this capture in it, or no such map.
    """
    if settings.captured.truth is None:
        return []
    folder = settings.captured.truth / capture
    if not folder.is_dir():
        raise TronError("captured.truth holds nothing of this capture", folder, MEND)
    views = read_capture_folder(folder).views
    mapped = [view for view in views if view.has("base_color") and view.has("mask")]
    if not mapped:
        raise TronError("no true view has base color and a mask", folder, MEND)
    return mapped


def _views(folder: Path, settings: Settings) -> int:
    """Number of views in a folder; TronError where it cannot be used."""
    if not (folder / ENVIRONMENT_NAME).is_file():
        raise TronError(
            "the light of the relit views is missing", folder / ENVIRONMENT_NAME, "make them again"
        )
    views, frames = len(read_capture_folder(folder).views), settings.captured.relit_frames
    if views < frames:
        raise TronError(
            f"{views} relit views, a clip has {frames}", folder, "make captured.relit_frames smaller"
        )
    return views

"""Checks of a curriculum against its splits and its network, before anything is decoded or trained."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from train.curriculum import Stage
from train.examples.framing import covering_size
from train.examples.sources import MOST_TRIES
from tron.errors import TronError
from tron.neural.kinds import OURS, kind_of
from tron.neural.protocols import Renderer
from tron.shards.clip_store import ClipStore
from tron.shards.schema import ClipMeta


def firsts_whole(clips: ClipStore, members: Sequence[str] = ()) -> list[ClipMeta]:
    """Metadata of the first undamaged clip of each split of a store, by :func:`first_whole`."""
    return [first_whole(clips, members, start) for start in clips.first_of_splits()]


def first_whole(clips: ClipStore, members: Sequence[str] = (), start: int = 0) -> ClipMeta:
    """Metadata of the first clip, from a number on, whose metadata and first frame can be read.

    Raises:
        TronError: none of 64 clips of one split can be read; it says what is wrong with the first.
    """
    failure: TronError | None = None
    for number in range(start, min(start + MOST_TRIES, len(clips))):
        if clips.split_of(number) != clips.split_of(start):
            break
        try:
            meta = clips.meta(number)
            for name in members:
                clips.read_frames(number, [0], [name])
        except TronError as error:
            failure = failure or error
        else:
            return meta
    assert failure is not None
    raise failure


def require_members(clips: ClipStore, split: str, members: Sequence[str]) -> None:
    """Raise TronError, naming the buffer, if a split lacks a member that samples need."""
    for name in members:
        try:
            firsts_whole(clips, [name])
        except TronError as error:
            raise TronError(
                f"split '{split}' gives no buffer '{name}': {error.what}",
                error.where,
                error.mend or "choose renderer.config.guidance among the buffers that the dataset holds",
            ) from error


def require_clips(split: str, clips: int, processes: int) -> None:
    """Raise TronError if a split has fewer clips than there are training processes."""
    if clips < processes:
        raise TronError(
            f"split '{split}' has {clips} clips for {processes} processes",
            mend="train on fewer devices, or make more clips",
        )


def require_fit(stage: Stage, split: str, first: ClipMeta) -> None:
    """Raise TronError if clips like the first of a split are too short or too small for a stage."""
    if first.frames < stage.frames:
        raise TronError(
            f"stage {stage.name} needs clips of {stage.frames} frames, split '{split}' has {first.frames}",
            mend="make longer clips, or shorten the stage's frames",
        )
    width, height = require_size(stage, split, first)
    if stage.crop and stage.crop > min(width, height):
        raise TronError(f"stage {stage.name} crops {stage.crop} pixels of {width} x {height}")


def require_size(stage: Stage, split: str, first: ClipMeta) -> tuple[int, int]:
    """Size of a stage's frames before its crop; TronError if a split's frames are smaller."""
    if stage.size is not None:
        try:
            covering_size((first.width, first.height), stage.size)
        except TronError as error:
            raise TronError(error.what, f"stage {stage.name}, split '{split}'", error.mend) from error
    return stage.size or (first.width, first.height)


def require_renderer(stage: Stage, renderer: Renderer) -> None:
    """Raise TronError if a network does not fit a stage's crop, size, frames or weights."""
    block, factor = renderer.space_block, renderer.temporal_factor
    if (stage.frames - 1) % factor:
        raise TronError(
            f"stage {stage.name} has {stage.frames} frames, the renderer takes 1 + {factor}n",
            mend=f"give it {1 + factor * max(1, (stage.frames - 1) // factor)}",
        )
    sides = {"crop": (stage.crop,) if stage.crop else (), "size": stage.size or ()}
    for key, given in sides.items():
        if odd := [side for side in given if side % block]:
            raise TronError(
                f"stage {stage.name} has a {key} of {odd[0]} pixels, the renderer takes multiples of {block}",
                mend=f"give it {max(block, odd[0] // block * block)}",
            )


def require_drawing(renderer: Renderer, stages: Sequence[Stage]) -> None:
    """Raise TronError unless a user's network gives a picture of the input's size, finite, with gradients.

    The test input is half grey, with each stage's crop (64 x 64 without one) and frames.
    """
    kind = kind_of(renderer)
    if kind in OURS:
        return
    for frames, side in sorted({(stage.frames, stage.crop or 64) for stage in stages}):
        given = {name: torch.zeros(1, 3, frames, side, side) for name in renderer.config.guidance}
        try:
            drawn = renderer(given)
        except TronError:
            raise
        except Exception as error:
            raise TronError(f"{kind} fails on {frames} x {side} x {side} pixels: {error}") from error
        shape = (1, 3, frames, side, side)
        if not isinstance(drawn, torch.Tensor) or drawn.shape != shape:
            got = tuple(drawn.shape) if isinstance(drawn, torch.Tensor) else type(drawn).__name__
            raise TronError(
                f"{kind} returns {got} for buffers of {shape}", mend="return the shape of a buffer"
            )
        if not torch.isfinite(drawn).all():
            raise TronError(f"{kind} returns NaN or infinity for half grey", mend="begin near its guidance")
        if not drawn.requires_grad:
            raise TronError(
                f"{kind} returns a picture without gradients", mend="do not detach what is trained"
            )

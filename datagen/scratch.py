"""Disk that scenes take while they are made, beyond what stays of them: views and frames that wait on it."""

from __future__ import annotations

from datagen.settings import Settings
from datagen.view_spool import view_bytes
from tron.shards.schema import MEMBERS, clip_members

PICTURE_BYTES = 32
"""Bytes of a pixel of a scene's own pictures: 8-bit colours and half-float maps, that hardly compress."""
CHECKPOINT_BYTES = 1200
"""Bytes of a surfel in a reconstruction's checkpoint: parameters and two moments of Adam, and a copy."""


def scratch_bytes(settings: Settings, split: str, photos: int = 0) -> int:
    """Bytes on disk that one scene of a split takes at the most while it is made, and then no more.

    A capture has its checkpoint, and frames of all its ``photos``, until its clips are written.
    """
    recipe = settings.split(split)
    members = (MEMBERS[name] for name in clip_members(recipe.reference_buffers))
    pixel = sum(max(member.bytes, 2) * member.channels for member in members)
    if settings.source == "captured":
        most = settings.captured.reconstruction.radiance.density.most
        return most * CHECKPOINT_BYTES + photos * recipe.width * recipe.height * pixel
    views = settings.views + (-(-settings.views // 2) if recipe.moving_objects else 0)
    clip = recipe.frames * recipe.width * recipe.height
    judges = view_bytes(recipe.frames, recipe.width, recipe.height)
    refined = view_bytes(views, settings.view_width, settings.view_height) + judges
    pictures = settings.views * settings.view_width * settings.view_height * PICTURE_BYTES
    reconstructed = pictures + settings.surfels * CHECKPOINT_BYTES
    spooled = clip * pixel * (len(recipe.lights) if recipe.lights_share_path is not False else 1)
    shares, rebuilt = settings.surfels_from, 0
    if shares.reconstruction:  # it lies there until the clips are written
        rebuilt = reconstructed
    made = refined if settings.refine_steps and shares.gbuffers else 0
    return max(made, rebuilt + max(judges if rebuilt else 0, spooled))

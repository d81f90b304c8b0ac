"""Masks that lie beside photos, where nerfstudio, COLMAP and people put them.

A mask is an image of its photo's size; what is black in it is masked out. ``ignore``, the meaning that
nerfstudio and COLMAP give it: nothing is learnt from these pixels (a passer-by, the photographer's shadow, a
car's hood). ``subject``: these pixels are empty background around the subject, as those that a photo's own
alpha hides.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

MaskMeaning = Literal["ignore", "subject"]

_BESIDE = "_mask"
_FOLDER = "masks"
_LEVELS = 3
_REDUCED = re.compile(r".+(_\d{1,3})")
_HALF = 127


def find_mask(photo: Path) -> Path | None:
    """The mask of a photo, if there is one.

    Looked for are ``NAME_mask.png`` beside it, then, in the folders above it, ``masks/images/NAME.jpg.png``
    (COLMAP's) and ``masks/images/NAME.png``, with and without ``images``; for photos in ``images_4`` also
    ``masks_4``.
    """
    beside = photo.with_name(f"{photo.stem}{_BESIDE}.png")
    if beside.is_file():
        return beside
    for folder in photo.parents[:_LEVELS]:
        inner = photo.relative_to(folder)
        reduced = _REDUCED.fullmatch(inner.parts[0]) if len(inner.parts) > 1 else None
        for masks in (f"{_FOLDER}{reduced[1]}", _FOLDER) if reduced else (_FOLDER,):
            if not (folder / masks).is_dir():
                continue
            for name in (inner, Path(*inner.parts[1:])) if len(inner.parts) > 1 else (inner,):
                for path in (folder / masks / f"{name}.png", folder / masks / name.with_suffix(".png")):
                    if path.is_file():
                        return path
    return None


def beside_reduced(photo: Path, mask: Path | None) -> Path | None:
    """The mask in ``masks_4`` for a photo in ``images_4``, where both are there; else ``mask`` itself."""
    reduced = _REDUCED.fullmatch(photo.parent.name)
    if mask is None or reduced is None:
        return mask
    small = mask.parent.with_name(mask.parent.name + reduced[1]) / mask.name
    return small if small.is_file() else mask


def is_mask(path: Path, stems: set[str]) -> bool:
    """Whether an image is the mask of another one beside it, by its name.

    Args:
        path: the image.
        stems: names of all images beside it, without suffixes.
    """
    return path.stem.endswith(_BESIDE) and path.stem.removesuffix(_BESIDE) in stems


def mask_values(stored: np.ndarray, meaning: MaskMeaning) -> np.ndarray:
    """(H, W, 1) uint8, 255 where a mask lets its photo count.

    Args:
        stored: (H, W, C) uint8 or uint16 as decoded; alpha is passed over.
        meaning: of a mask to ignore by, what is brighter than half counts; of a subject, greys are the
            coverage of its edge. A mask of zeros and ones is meant to be black and white.
    """
    grey = stored[..., : min(stored.shape[2], 3)].max(axis=2, keepdims=True)
    if grey.dtype == np.uint16:
        grey = (grey >> 8).astype(np.uint8)
    if grey.max() == 1:
        return (grey * 255).astype(np.uint8)
    return grey if meaning == "subject" else np.where(grey > _HALF, 255, 0).astype(np.uint8)

"""Hash of what views show, by which replaced files are known."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from tron.captures.view import MAPS, View


def content_hash(views: Iterable[View]) -> str:
    """SHA-256 of the views' names, cameras, images and maps, as 64 hexadecimal digits.

    Values are hashed as they are read, so that whatever changes them counts: a file that was replaced, its
    size, the exposure of an EXR, the way that masks are taken.

    Raises:
        TronError: an image or map that cannot be read.
    """
    digest = hashlib.sha256()
    for view in views:
        digest.update(repr((view.name, view.camera.to_dict(), view.space)).encode())
        for field in MAPS:
            if view.has(field):
                digest.update(field.encode())
                digest.update(view.read(field).tobytes())
    return digest.hexdigest()

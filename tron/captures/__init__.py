"""Captures: posed views of a scene, photographed or path-traced; the same type for both."""

from typing import TYPE_CHECKING

from tron.lazily import lazily

if TYPE_CHECKING:
    from tron.captures.capture import Capture
    from tron.captures.load import LoadSettings, load_capture
    from tron.captures.view import View

__all__ = ["Capture", "LoadSettings", "View", "load_capture"]

__getattr__ = lazily(__name__, {"capture": "Capture", "load": "LoadSettings load_capture", "view": "View"})

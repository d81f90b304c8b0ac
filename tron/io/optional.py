"""Libraries of formats that few need: asked for where a file has such a format."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

from tron.errors import TronError


def codecs(wanted: str) -> ModuleType:
    """The library imagecodecs, of the extra ``lights``, or TronError that names what is ``wanted``."""
    try:
        import imagecodecs
    except ModuleNotFoundError as error:
        raise _absent("imagecodecs", wanted, "lights") from error
    return imagecodecs


def basisu(wanted: str) -> ModuleType:
    """The library opengl_basisu, of the extra ``ktx2``, or TronError that names what is ``wanted``."""
    try:
        import opengl_basisu
    except ModuleNotFoundError as error:
        raise _absent("opengl_basisu", wanted, "ktx2") from error
    return opengl_basisu


def usd(wanted: str) -> tuple[Any, Any, Any, Any]:
    """Sdf, Usd, UsdGeom and Gf of usd-core, of the extra ``usd``, or TronError that names what asks."""
    try:
        sdf, stages = importlib.import_module("pxr.Sdf"), importlib.import_module("pxr.Usd")
        return sdf, stages, importlib.import_module("pxr.UsdGeom"), importlib.import_module("pxr.Gf")
    except ModuleNotFoundError as error:
        raise _absent("usd-core", wanted, "usd") from error


def _absent(name: str, wanted: str, extra: str) -> TronError:
    return TronError(f"{wanted}: needs {name}", mend=f"pip install 'tron-relight[{extra}]'")

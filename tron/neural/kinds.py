"""Renderer classes by their names in weights files: our classes, and classes of installed packages.

A file names its class and never has it imported. Found are those that its reader has imported already, and
those that a package he installed declares as an entry point of the group `tron.networks`.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import get_type_hints

from tron.errors import TronError
from tron.neural.configs import GuidedConfig
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.protocols import Renderer
from tron.neural.renderer import NeuralRenderer

GROUP = "tron.networks"
OURS: dict[str, type[Renderer]] = {"neural": NeuralRenderer, "pixel_mlp": PixelMLP}


def kind_of(renderer: Renderer) -> str:
    """Return the name of a renderer's class for weights files: a short name for ours, else MODULE:CLASS.

    Raises:
        TronError: no reader could find the class, since a module does not have it by that name.
    """
    cls = type(renderer)
    for kind, ours in OURS.items():
        if cls is ours:
            return kind
    kind = f"{cls.__module__}:{cls.__qualname__}"
    if cls.__module__ == "__main__" or _imported(kind) is not cls:
        raise TronError(
            f"weights of {kind} could not be read again",
            mend="define the class at the top of a module that can be imported",
        )
    return kind


def renderer_class(kind: str, where: Path | None = None) -> type[Renderer]:
    """Return the class that a weights file names.

    Args:
        kind: as `kind_of` has it.
        where: the file, for messages.

    Raises:
        TronError: no class of ours, none imported, and no installed package declares it.
    """
    if kind in OURS:
        return OURS[kind]
    if (cls := _imported(kind)) is not None:
        return cls
    for entry in entry_points(group=GROUP):
        if entry.value.replace(" ", "") == kind:
            try:
                entry.load()
            except (ImportError, AttributeError) as error:
                raise TronError(f"the network {kind} cannot be imported: {error}", where) from error
            if (cls := _imported(kind)) is not None:
                return cls
    package = kind.split(":")[0].split(".")[0]
    raise TronError(
        f"these are weights of {kind}, a network that no installed package declares",
        where,
        f"install the package that has it (module {package}, entry point of {GROUP!r}), or import it first",
    )


def config_class(cls: type[Renderer]) -> type[GuidedConfig]:
    """Return the class of a renderer's settings: the type of its attribute `config`."""
    return get_type_hints(cls)["config"]


def _imported(kind: str) -> type[Renderer] | None:
    module, _, name = kind.partition(":")
    found = getattr(sys.modules.get(module), name, None)
    return found if isinstance(found, type) and issubclass(found, Renderer) else None

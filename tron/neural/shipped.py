"""Checkpoints that come with the package, by name. Loads no torch.

Their files lie in the folder `shipped` beside this one as NAME.safetensors; its README has a model card each.
"""

from __future__ import annotations

from pathlib import Path

from tron.errors import TronError

FOLDER = Path(__file__).with_name("shipped")
SHIPPED = {
    "surfaces": "of pbr, irradiance, lit, albedo and surface",
    "paper": "of pbr and irradiance, the paper's buffers",
}
"""Name -> description of the network's input."""
DEFAULT = "surfaces"
"""Name of the checkpoint that ``auto`` means."""
AUTO = "auto"
"""Default of ``checkpoint``: :data:`DEFAULT`, or a way that surely gains more."""


def installed() -> dict[str, Path]:
    """Return name -> file of the shipped checkpoints in this installation."""
    files = {name: FOLDER / f"{name}.safetensors" for name in SHIPPED}
    return {name: path for name, path in files.items() if path.is_file()}


def shipped(name: str) -> Path:
    """Return the file of a shipped checkpoint.

    Raises:
        TronError: no checkpoint has this name, or this installation came without its file.
    """
    if name not in SHIPPED:
        raise TronError(f"no shipped checkpoint is called {name!r}", mend=f"they are {', '.join(SHIPPED)}")
    path = installed().get(name)
    if path is None:
        mend = "give the path of a renderer.safetensors that tron-train wrote"
        raise TronError(f"this installation has no checkpoint '{name}'", FOLDER, mend)
    return path


def checkpoint_file(checkpoint: str | Path) -> Path:
    """Return the file that a setting such as `checkpoint` means: of a shipped name, or the path itself.

    A name wins over a file that is called like it. Raises TronError where a name's file did not come with
    this installation.
    """
    name = str(checkpoint)
    return shipped(name) if name in SHIPPED else Path(checkpoint)

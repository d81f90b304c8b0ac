"""Frames of a run on disk: linear buffers that are rendered once, and pictures made from them.

A file appears under its name only when it is whole, so a frame is finished exactly if its files are there.
What the frames were made with stands beside them; frames of other settings are never mixed in silently.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.io.images import read_image, write_image
from tron.io.video import VideoWriter
from tron.report.contact_sheet import labelled_sheet
from tron.run_folder import RunFolder
from tron.shards.schema import MEMBERS

SETTINGS_NAME = "settings.json"
# Lengths need more digits than half floats have.
_FULL_PRECISION = ("depth", "position")
_SHEET_COLUMNS = 6
_SHEET_WIDTH = 320


class FrameFolder:
    """Files NNNN.NAME.exr (linear or plain values) and NNNN.NAME.png (display) in one folder.

    Args:
        folder: where they are; made by `claim`.
        buffers: names of the buffers that a finished frame has.
    """

    def __init__(self, folder: Path, buffers: Sequence[str]) -> None:
        self.folder = folder
        self.buffers = tuple(buffers)

    def claim(self, made_with: Mapping[str, Any], overwrite: bool) -> None:
        """Take the folder for frames made with these settings (JSON values), keeping those that already are.

        Raises TronError if the folder holds frames made with others, unless `overwrite` deletes them.
        """
        mend = "choose another output_dir, or replace them with overwrite=true"
        run = RunFolder(self.folder, "frames", SETTINGS_NAME, mend)
        if overwrite and run.difference(made_with) is not None:
            run.clear("*.exr", "*.png", "exposure.json")
        else:
            run.require(made_with)
        run.keep(made_with)

    def path(self, index: int, name: str, suffix: str) -> Path:
        """File of frame `index`'s buffer or picture `name`; suffix "exr" or "png"."""
        return self.folder / f"{index:04d}.{name}.{suffix}"

    def finished(self, index: int) -> bool:
        """Whether every buffer of the frame is there, and hence whole."""
        return all(self.path(index, name, "exr").exists() for name in self.buffers)

    def lacking(self, frames: int) -> list[str]:
        """Names of buffers that are missing in frames which have others of them."""
        missing = set()
        for index in range(frames):
            there = {name for name in self.buffers if self.path(index, name, "exr").exists()}
            missing |= set(self.buffers) - there if there else set()
        return sorted(missing)

    def write(self, index: int, images: Mapping[str, np.ndarray]) -> None:
        """Write a frame's buffers. Raises TronError, and writes nothing, if one of them is not finite."""
        for name in self.buffers:
            if not np.isfinite(images[name]).all():
                raise TronError(f"buffer {name} of frame {index} is not finite", self.folder)
        for name in self.buffers:
            path = self.path(index, name, "exr")
            color = name not in MEMBERS or MEMBERS[name].color_space is not None
            write_image(path, images[name], half=name not in _FULL_PRECISION, color=color)

    def read(self, index: int, name: str) -> np.ndarray:
        """A frame's buffer as (H, W, 3) float32."""
        return read_image(self.path(index, name, "exr"))

    def write_picture(self, index: int, name: str, display: np.ndarray) -> None:
        """Write display values in [0, 1], (H, W, 3) or with straight alpha (H, W, 4), as NNNN.NAME.png."""
        write_image(self.path(index, name, "png"), display)

    def row(self, index: int, names: Sequence[str]) -> np.ndarray:
        """A frame's pictures side by side, (H, W * len(names), 3) display values; with alpha, over black."""
        return np.concatenate([_over_black(self.path(index, name, "png")) for name in names], axis=1)

    def write_video(self, path: Path, frames: int, names: Sequence[str], fps: float) -> None:
        """Write the pictures of all frames, side by side, as a video."""
        height, width = self.row(0, names).shape[:2]
        with VideoWriter(path, fps, (width, height)) as video:
            for index in range(frames):
                video.write(self.row(index, names))

    def write_sheet(self, path: Path, frames: int, names: Sequence[str]) -> None:
        """Write a contact sheet: a column for each of a few frames evenly spread, a row a picture."""
        columns = np.linspace(0, frames, min(frames, _SHEET_COLUMNS), endpoint=False).astype(int)
        width = min(read_image(self.path(0, names[0], "png")).shape[1], _SHEET_WIDTH)
        rows = {name: [self.row(index, [name]) for index in columns] for name in names}
        sheet = labelled_sheet(rows, [f"frame {index}" for index in columns], width)
        write_image(path, sheet.astype(np.float32) / 255)


def _over_black(path: Path) -> np.ndarray:
    picture = read_image(path, channels=4)
    return picture[..., :3] * picture[..., 3:]

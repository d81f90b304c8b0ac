"""Files of what is made of a scan once: its materials and its proxy for light."""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from tron.gaussians.ply import header_comments

log = logging.getLogger(__name__)

Kind = Literal["materials", "proxy"]


@dataclass(frozen=True)
class KeptFiles:
    """Where what is made of a scan lies: beside it, as NAME.KIND.ply, or apart where it cannot lie there.

    Attributes:
        scan: its file.
        apart: folder of a command's output, where files lie if the scan's folder cannot be written.
    """

    scan: Path
    apart: Path

    def candidates(self, kind: Kind) -> tuple[Path, Path]:
        """The file beside the scan, and the one apart; neither need be there."""
        beside = self.scan.with_suffix(f".{kind}.ply")
        return beside, self.apart / beside.name

    def found(self, kind: Kind, made_from: str) -> Path | None:
        """The file that says that it was made from this; None where there is none, with a line of others."""
        said = f"{kind} {made_from}"
        files = [path for path in dict.fromkeys(self.candidates(kind)) if made_as_now(path, said)]
        return files[0] if files else None

    def known(self, kind: Kind, made_from: str) -> Path | None:
        """The same without a word."""
        said = f"{kind} {made_from}"
        return next((path for path in self.candidates(kind) if said in header_comments(path)), None)

    def path(self, kind: Kind, made_from: str) -> Path:
        """The file that was made from this, or else the one to write."""
        return self.known(kind, made_from) or self.candidates(kind)[not self._beside]

    @cached_property
    def _beside(self) -> bool:
        """Whether files can be made in the scan's folder; a line says where they lie if not."""
        if _takes_files(self.scan.parent):
            return True
        log.info(
            "%s cannot be written: materials and the proxy of %s, if it needs any, are kept in %s",
            self.scan.parent, self.scan.name, self.apart,
        )  # fmt: skip
        return False


def made_as_now(path: Path, said: str) -> bool:
    """Whether a kept file says what it would be made from now, "KIND DIGEST"; a line if it says another."""
    comments, kind = header_comments(path), said.split()[0]
    if said not in comments and any(comment.startswith(f"{kind} ") for comment in comments):
        log.info("%s was made of another scan, or as another version does it: it is made anew", path)
    return said in comments


def _takes_files(folder: Path) -> bool:
    """Whether a file can be made in a folder. It is tried: bits do not tell of root or a read-only mount."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False

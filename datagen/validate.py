"""Check a dataset folder: are its shards what its manifest says, and its scenes what its shards need?"""

from __future__ import annotations

import logging
from pathlib import Path

from tron.shards.manifest import Manifest, verify

log = logging.getLogger(__name__)


def validate(folder: Path) -> int:
    """Log every problem of a dataset, one line each, and return their number.

    Beside what ``tron.shards.manifest.verify`` finds in the shards, every scene that has clips must still
    have its specification and its surfels.

    Raises:
        TronError: the folder is no dataset at all.
    """
    problems = verify(folder)
    manifest = Manifest.load(folder)
    scenes = sorted({key.rsplit("-l", 1)[0] for entry in manifest.shards for key in entry.keys})
    for scene in scenes:
        for name in ("spec.json", "surfels.ply"):
            if not (folder / "scenes" / scene / name).is_file():
                problems.append(f"scenes/{scene}/{name}: missing")
    for problem in problems:
        log.error("%s", problem)
    clips = sum(entry.samples for entry in manifest.shards)
    log.info("%d shards, %d clips, %d problems", len(manifest.shards), clips, len(problems))
    return len(problems)

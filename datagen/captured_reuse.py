"""Reconstructions taken over from another dataset of the same captures, so that each is made once.

``captured.reconstructed=FOLDER`` is a dataset that was made with the same photos, prior and schedule: another
frame size, other splits or lights need no other surfels.
"""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

from datagen.captured_reconstruction import ENVIRONMENT_NAME, SPEC_NAME, SURFELS_NAME
from datagen.plan import CONFIG_NAME, Work
from datagen.settings import Settings
from tron.captures import Capture
from tron.claim import read_recipe, require_same
from tron.cli.recipes import model_defaults
from tron.errors import TronError
from tron.storage import atomic_path, write_atomic

log = logging.getLogger(__name__)

DECIDES = ("prior", "photos", "reconstruction", "light")
"""Keys of ``captured`` that decide what a reconstruction is, beside seed and variant."""

FOUND = (SURFELS_NAME, ENVIRONMENT_NAME)
"""Files of a reconstruction beside its spec.json."""


def require_reusable(settings: Settings) -> None:
    """Make sure that ``captured.reconstructed`` is a dataset of captures, reconstructed as this one would be.

    Raises:
        TronError: it is not; names the first key that differs.
    """
    folder = settings.captured.reconstructed
    if folder is None:
        return
    mend = "give the folder of a dataset made with source=captured"
    described = read_recipe(folder / CONFIG_NAME)
    if described is None or described.get("recipe", {}).get("source") != "captured":
        raise TronError("captured.reconstructed is no dataset of captures", folder, mend)
    before, now = (_decisive(recipe) for recipe in (described["recipe"], settings.recipe()))
    require_same(
        before,
        now,
        folder,
        "reconstructions",
        "leave captured.reconstructed out, or give the keys that they were made with",
        defaults=_decisive(model_defaults(Settings)),
    )


def take_over(item: Work, settings: Settings, capture: Capture, folder: Path) -> bool:
    """Copy the reconstruction of the same photos into a scene's folder, spec.json last; False without one."""
    source = settings.captured.reconstructed
    for spec in sorted(source.glob(f"scenes/*/{SPEC_NAME}")) if source is not None else ():
        try:
            text = spec.read_text("utf-8")
            facts = json.loads(text)
            same = facts["capture"] == item.capture and facts["content"] == capture.content
            same = same and all((spec.parent / name).is_file() for name in FOUND)
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if same:
            log.info("%s (%s): reconstruction of %s", item.name, item.capture, spec.parent)
            for name in FOUND:
                with atomic_path(folder / name) as path:
                    shutil.copyfile(spec.parent / name, path)
            write_atomic(folder / SPEC_NAME, text)
            return True
    return False


def _decisive(recipe: dict[str, Any]) -> dict[str, Any]:
    captured = {name: recipe.get("captured", {}).get(name) for name in DECIDES}
    return {"seed": recipe.get("seed"), "variant": recipe.get("variant"), "captured": captured}

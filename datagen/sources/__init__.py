"""Sources of clips: synthetic scenes and captures."""

from __future__ import annotations

from datagen.settings.command import Settings
from datagen.sources.captured import CapturedSource
from datagen.sources.source import Source
from datagen.sources.synthetic import SyntheticSource

SOURCES: dict[str, Source] = {"synthetic": SyntheticSource(), "captured": CapturedSource()}
"""Every source, by its name in ``source``."""


def source_of(settings: Settings) -> Source:
    """Return the settings' source."""
    return SOURCES[settings.source]

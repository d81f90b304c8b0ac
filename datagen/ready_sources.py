"""The user's files, ready to be drawn from: catalogued, held against the checklist and other datasets."""

from __future__ import annotations

from datagen.disjoint import require_disjoint
from datagen.plan import Sources, find_sources
from datagen.settings import Settings
from datagen.source_list import require_slots, tell_shared


def ready_sources(settings: Settings) -> Sources:
    """Catalogue the user's files before any render.

    Raises:
        TronError: as ``datagen.assets`` does; a checklist that cannot be read; something that a dataset of
            ``disjoint_from`` trains on.
    """
    sources = require_slots(settings, find_sources(settings))
    tell_shared(settings, sources)
    require_disjoint(settings, sources)
    return sources

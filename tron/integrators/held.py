"""Parameters that are remembered, to see whether they have changed."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


class Held:
    """A parameter, equal to itself while its variables are the same; held, so that none takes their place."""

    def __init__(self, value: Any) -> None:
        self._value = dr.detach(value) if dr.is_array_v(value) else value
        self._identity = mi.util._jit_id_hash(value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Held) and self._identity == other._identity

"""Specifications: frozen data whose JSON is the same bytes on every machine.

A specification says everything about a thing that is to be made and nothing about how. Its numbers are
rounded to six decimals when they enter, so that a sine that differs in its last bit between two processors
does not change the file, and what is made from a file read back is what was made the first time.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict


def _rounded(value: object) -> object:
    return (
        round(float(value), 6) + 0.0
        if isinstance(value, (int, float)) and not isinstance(value, bool)
        else value
    )


Number = Annotated[float, BeforeValidator(_rounded)]
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]


class Spec(BaseModel):
    """Base of every specification: immutable, strict about names, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def to_json(self) -> str:
        """JSON text: fields in the order of their declaration, indented by one space, a final newline."""
        return self.model_dump_json(indent=1) + "\n"


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two positive ones, even in its logarithm: scales have no favourite."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))

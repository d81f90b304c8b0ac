"""Settings that trade time for memory; they load no torch."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class MemorySettings(BaseModel):
    """Memory of the backward pass."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    checkpoint_activations: bool = Field(
        default=False,
        description="Keep only what goes into each block of a transformer, and do the block again in the "
        "backward pass: a third more time for a small part of the memory.",
    )

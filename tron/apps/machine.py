"""What commands are told of the machine that they run on."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

Variant = Annotated[
    Literal["llvm_ad_rgb", "cuda_ad_rgb"], Field(description="Mitsuba variant: processor or NVIDIA GPU")
]
Threads = Annotated[int | None, Field(ge=1, description="threads of the renderer; null: all")]

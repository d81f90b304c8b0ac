"""Settings of what a scene's surfels are made from: its true G-buffers, or a reconstruction from pictures."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from datagen.settings_model import SettingsModel
from tron.seeds import generator

Source = Literal["gbuffers", "reconstruction"]
PriorName = Literal["ground_truth", "joint"]


class SurfelSources(SettingsModel):
    """Shares of the scenes by what their surfels are made from; the name of one alone gives it all."""

    gbuffers: float = Field(
        default=1.0,
        ge=0,
        description="Share of scenes whose surfels are made from true G-buffers: clean guidance, soon made.",
    )
    reconstruction: float = Field(
        default=0.0,
        ge=0,
        description="Share of scenes whose surfels are reconstructed from path-traced pictures, as captures "
        "are: their flaws are in the guidance, for the network to mend.",
    )

    @model_validator(mode="before")
    @classmethod
    def _one_alone(cls, value: Any) -> Any:
        if value in ("gbuffers", "reconstruction"):
            return {"gbuffers": 0.0, "reconstruction": 0.0, value: 1.0}
        return value

    @model_validator(mode="after")
    def _some(self) -> SurfelSources:
        if not self.gbuffers + self.reconstruction > 0:
            raise ValueError("one share must be above 0")
        return self

    def of(self, seed: int, split: str, index: int) -> Source:
        """Source of a scene's surfels, a function of root seed, split and index alone."""
        total = self.gbuffers + self.reconstruction
        drawn = generator(seed, split, index, "surfels_from").random() * total
        return "reconstruction" if drawn < self.reconstruction else "gbuffers"


class SurfelReconstruction(SettingsModel):
    """Reconstruction of a scene's surfels from its own views, path-traced under one of its lights."""

    prior: PriorName = Field(
        default="ground_truth",
        description="ground_truth: the scene's true normals and materials guide it, as a very good prior "
        "would; joint: nothing but the pictures.",
    )
    steps_scaler: float = Field(
        default=0.1,
        gt=0,
        le=100,
        description="Factor on the steps of its stages: 0.1 takes 3,000 + 700, 1 the paper's 30,000 + 7,000.",
    )
    path_spp: int = Field(default=64, ge=1, description="Paths per pixel of the views.")
    reference_spp: int = Field(
        default=16, ge=2, description="Shadow rays per pixel of their true irradiance, which is kept beside."
    )
    checkpoint_every: int = Field(
        default=500, ge=1, description="Steps between checkpoints, which an interrupted run goes on from."
    )

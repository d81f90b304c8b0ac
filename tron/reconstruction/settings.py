"""What a reconstruction can be told: stage 1 (radiance and geometry), its density control, stage 2 (materials).

The defaults are those of 3DGRT, which the paper inherits (facts.md section 2): 30,000 steps, then 7,000. A
machine without a GPU takes fewer of them: ``scaled`` shortens every schedule at once, as gsplat's
``steps_scaler`` does.
"""

from __future__ import annotations

from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Model = TypeVar("Model", bound="_Model")


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class InitialSettings(_Model):
    """Where the first surfels come from."""

    source: Literal["auto", "points", "depth", "random"] = Field(
        "auto",
        description="points of the capture (COLMAP's), depth maps of its views, or random points in the "
        "cameras' box; auto: points where there are any, else depth, else random.",
    )
    count: int = Field(
        100_000, ge=4, description="Number of surfels made from depth maps or random points, about."
    )
    opacity: float = Field(0.1, gt=0.005, lt=1, description="Opacity of surfels made from points.")
    kernel_degree: Literal[2, 4] = Field(
        2, description="Kernel of the surfels: 2, Gaussian, or 4, 3DGRT's flatter and sharper one."
    )


class DensitySettings(_Model):
    """Where surfels are added and taken away, after "3D Gaussian Splatting" (Kerbl et al. 2023)."""

    start: int = Field(500, ge=0, description="First step after which surfels are added.")
    end: int = Field(15_000, ge=0, description="Step from which none is added and no opacity is reset.")
    every: int = Field(300, ge=1, description="Steps between two additions.")
    threshold: float = Field(
        2e-4,
        gt=0,
        description="Mean gradient of the position times half the distance to the camera, above which a "
        "surfel is cloned or split.",
    )
    clone_below: float = Field(
        0.01, gt=0, description="Surfels up to this scale, in extents, are cloned, larger ones split in two."
    )
    split_shrink: float = Field(1.6, gt=1, description="What the scales of a split surfel are divided by.")
    prune_every: int = Field(100, ge=1, description="Steps between two prunings.")
    prune_below: float = Field(0.005, ge=0, lt=1, description="Opacity below which a surfel is removed.")
    reset_every: int = Field(
        3000, ge=0, description="Steps between two resets of all opacities; 0 never resets them."
    )
    reset_to: float = Field(0.01, gt=0, lt=1, description="Greatest opacity after a reset.")
    most: int = Field(1_000_000, ge=4, description="Most surfels; those with the largest gradient come first.")


class RadianceSettings(_Model):
    """Stage 1: geometry and radiance. Rates are Adam's; positions' are in extents (see ``Capture extent``)."""

    steps: int = Field(30_000, ge=0, description="Steps; each renders one view.")
    position_rate: float = Field(1.6e-4, gt=0, description="First rate of the positions, in extents.")
    position_rate_final: float = Field(1.6e-6, gt=0, description="Last one; it falls log-linearly.")
    opacity_rate: float = Field(0.05, gt=0, description="Rate of the opacities' logits.")
    sh_rate: float = Field(2.5e-3, gt=0, description="Rate of the constant harmonic.")
    sh_rest_rate: float = Field(1.25e-4, gt=0, description="Rate of the other harmonics.")
    rotation_rate: float = Field(1e-3, gt=0, description="Rate of the quaternions.")
    scale_rate: float = Field(5e-3, gt=0, description="Rate of the scales' logarithms.")
    sh_degree: int = Field(3, ge=0, le=3, description="Highest degree of the radiance's harmonics.")
    sh_every: int = Field(1000, ge=1, description="Steps after which one more degree is learnt.")
    ssim: float = Field(0.2, ge=0, le=1, description="Weight of 1 - SSIM; L1 has the rest.")
    normal: float = Field(
        0.1, ge=0, description="lambda_n: weight of the same loss on normals, where a prior gives them."
    )
    mask: float = Field(0.2, ge=0, description="Weight of |opacity - mask|, where views have masks.")
    background: Literal["black", "white", "random"] = Field(
        "black", description="What lies behind the surfels, and behind the subject where views have masks."
    )
    density: DensitySettings = Field(default_factory=lambda: DensitySettings(), description="")

    def scaled(self, factor: float) -> RadianceSettings:
        """The same schedule in ``factor`` times as many steps; a step number of 0 stays 0."""
        density = _scaled(self.density, ("start", "end", "every", "prune_every", "reset_every"), factor)
        return _scaled(self, ("steps", "sh_every"), factor).model_copy(update={"density": density})


class MaterialSettings(_Model):
    """Stage 2: base color, roughness and metallic from the priors, geometry frozen."""

    steps: int = Field(7000, ge=0, description="Steps; each renders one view.")
    rate: float = Field(2.5e-3, gt=0, description="Adam's rate of base color, roughness and metallic.")
    ssim: float = Field(0.2, ge=0, le=1, description="Weight of 1 - SSIM; L1 has the rest.")

    def scaled(self, factor: float) -> MaterialSettings:
        """The same in ``factor`` times as many steps."""
        return _scaled(self, ("steps",), factor)


def _scaled(settings: Model, names: tuple[str, ...], factor: float) -> Model:
    values = {name: getattr(settings, name) for name in names}
    return settings.model_copy(
        update={name: max(round(value * factor), 1) if value else 0 for name, value in values.items()}
    )

"""Surfels that are nearly right, made better: every parameter answers to true G-buffers, none is added.

Surfels made straight from G-buffers blur what is smaller than they are and overhang silhouettes by a pixel.
Some steps of the reconstruction's own optimiser, on normals, materials and masks at once, place and shape
them to what the views show.
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from tron.captures import View
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.settings import Settings
from tron.reconstruction.supervision import MATERIALS, Weights
from tron.reconstruction.surfels import LearntSurfels
from tron.reconstruction.training import Plan, Stage, Watch


class RefinementSettings(Settings):
    """Rates are Adam's; the positions' is in surfel spacings."""

    steps: int = Field(default=200, ge=0, description="Steps; each renders one view; 0 leaves surfels alone.")
    position_rate: float = Field(default=0.01, gt=0, description="Rate of the positions, in spacings.")
    rotation_rate: float = Field(default=0.005, gt=0, description="Rate of the quaternions.")
    scale_rate: float = Field(default=0.01, gt=0, description="Rate of the scales' logarithms.")
    opacity_rate: float = Field(default=0.05, gt=0, description="Rate of the opacities' logits.")
    material_rate: float = Field(
        default=0.01, gt=0, description="Rate of base color, roughness and metallic."
    )
    normal: float = Field(default=0.5, ge=0, description="Weight of the normals' loss; base color has 1.")
    decay: float = Field(
        default=0.1, gt=0, le=1, description="Share of every rate that is left at the last step."
    )
    mask: float = Field(default=0.5, ge=0, description="Weight of |opacity - mask|.")
    surface: float = Field(default=0.2, ge=0, description="Weight of roughness and metallic.")


def refine(
    scene: GaussianScene,
    views: Sequence[View],
    settings: RefinementSettings,
    seed: int,
    device: str = "cpu",
    watch: Watch | None = None,
) -> GaussianScene:
    """The scene after ``settings.steps`` steps; object ids, spacing and order of the surfels are kept.

    Args:
        scene: surfels near the views' surfaces.
        views: with normal, base_color, roughness, metallic and mask, taken along pixel centres.
        settings: steps, rates, weights.
        seed: root of the views' order.
        device: torch's, that of the active Mitsuba variant.
        watch: called after each step.
    """
    if not settings.steps:
        return scene
    rates = {
        "means": settings.position_rate * scene.spacing,
        "quats": settings.rotation_rate,
        "log_scales": settings.scale_rate,
        "opacity_logits": settings.opacity_rate,
        **dict.fromkeys(MATERIALS, settings.material_rate),
    }
    plan = Plan(
        name="refinement",
        steps=settings.steps,
        weights=Weights(
            normal=settings.normal,
            mask=settings.mask,
            base_color=1.0,
            roughness=settings.surface,
            metallic=settings.surface,
        ),
        rates=rates,
        final_rates={name: settings.decay * rate for name, rate in rates.items()},
    )
    surfels = LearntSurfels.of_scene(scene, plan.rates, device)
    Stage(plan, views, surfels, scene.kernel_degree, seed).run(watch)
    found = surfels.scene(scene.kernel_degree, scene.up)
    found.object_id, found.spacing = scene.object_id, scene.spacing
    return found.validate()

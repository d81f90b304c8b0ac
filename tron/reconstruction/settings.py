"""Settings of a reconstruction: its beginning, and stages 1 (radiance), 2 (materials) and 3 (light).

The schedule is 3DGRT's, which the paper inherits (docs/concepts/reconstruction.md): 30,000 steps, then 7,000.
A machine without a GPU takes fewer of them: ``scaled`` shortens every schedule at once, as gsplat's
``steps_scaler`` does, and lets surfels move and turn faster, since otherwise they would not arrive.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, field_validator

from tron.estimation import FINAL, Brdf, Estimation, Estimator

Model = TypeVar("Model", bound="Settings")

Place = Literal["in place", "near", "anywhere"]
"""Where surfels begin: on the surface (depth maps), near it (stereo), or anywhere."""
Indoors = bool | Literal["auto"]
"""Whether photos were taken in a room; auto: decided from the reconstruction."""

_FASTER: dict[Place, tuple[float, float]] = {"in place": (0, 0), "near": (0.25, 0.5), "anywhere": (0.5, 0.5)}
"""Exponents of the shortening by which positions and rotations learn faster in fewer steps."""


class Settings(BaseModel):
    """Base of all settings here: they do not change, and know no other keys and no infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Smoothing = Annotated[float, Field(ge=0, description="Gaussian that smooths the fused field, voxels.")]
Share = Annotated[float, Field(ge=0, le=1)]
MostVoxels = Annotated[
    int, Field(ge=8, le=1024, description="Maximum number of voxels along the scene's longest side.")
]


class FusionSettings(Settings):
    """Fusion of the views' depths, and what they agree on; smoothed little, as rendered depths need."""

    truncation: ClassVar[float] = 4.0  # voxels at which fused distances are cut off
    sigma: Smoothing = 1.0
    most_voxels: MostVoxels = 160


class StereoSettings(FusionSettings):
    """Depth from photographs: plane sweep, then fusion."""

    planes: int = Field(default=64, ge=4, le=1024, description="Planes, even in inverse distance.")
    neighbours: int = Field(default=8, ge=1, description="Photos that each one is compared with.")
    angle: float = Field(
        default=12.0, gt=0, lt=180, description="Wanted angle between the views of two photos, degrees."
    )
    least_angle: float = Field(default=4.0, ge=0, lt=180, description="Smallest such angle, degrees.")
    most_angle: float = Field(default=40.0, gt=0, le=180, description="Largest such angle, degrees.")
    best: int = Field(
        default=4, ge=1, description="Neighbours that count, those that agree best: others are hidden."
    )
    radius: int = Field(default=2, ge=1, description="Radius of the compared windows, pixels.")
    confident: float = Field(
        default=0.55, ge=0, le=1, description="Least likeness, 1 - cost, of a depth that is fused."
    )
    most_side: int = Field(
        default=512, ge=16, description="Larger photos are reduced to so many pixels, which bounds memory."
    )
    unsure: float = Field(
        default=0.03,
        ge=0,
        le=1,
        description="Weight in the fusion of depths that no other photo confirms, where a mask tells of a "
        "surface.",
    )
    truncation: ClassVar[float] = 6.0  # depths by stereo are noisier than rendered ones
    sigma: Smoothing = 1.5


class InitialSettings(Settings):
    """First surfels of a capture."""

    source: Literal["auto", "points", "depth", "stereo", "random"] = Field(
        default="auto",
        description="points of the capture (COLMAP's), depth maps of its views, stereo, depth found by "
        "comparing the photos, or random points in the cameras' box; auto: points that are dense, else depth "
        "where there is any, else stereo, and where it finds nothing points or random ones.",
    )
    stereo: StereoSettings = Field(default=StereoSettings(), description="Depth by comparing photos.")
    count: int = Field(
        default=5000, ge=4, description="Approximate number of surfels made from depth maps or random points."
    )
    opacity: float = Field(default=0.3, gt=0.005, lt=1, description="Opacity of surfels made from points.")
    kernel_degree: Literal[2, 4] = Field(
        default=4, description="Kernel of the surfels: 2, Gaussian, or 4, 3DGRT's flatter and sharper one."
    )


class DensitySettings(Settings):
    """Surfels added and removed, after "3D Gaussian Splatting" (Kerbl et al. 2023)."""

    start: int = Field(default=500, ge=0, description="Step from which surfels are added.")
    end: int = Field(default=22_000, ge=0, description="Step from which none is added or removed.")
    every: int = Field(default=600, ge=1, description="Steps between two additions.")
    threshold: float = Field(
        default=4e-4,
        gt=0,
        description="Mean gradient of the position times half the distance to the camera, above which a "
        "surfel is cloned or split.",
    )
    prune_every: int = Field(default=100, ge=1, description="Steps between two prunings.")
    reset_every: int = Field(
        default=0, ge=0, description="Steps between two resets of all opacities; 0 never resets them."
    )
    most: int = Field(
        default=30_000,
        ge=4,
        description="Maximum number of surfels; those with the largest gradient come first.",
    )
    per_pixel: float | None = Field(
        default=None,
        gt=0,
        description="Maximum number of surfels over the pixels of a photo, where that is fewer; null: none.",
    )

    def seen_in(self, pixels: int) -> DensitySettings:
        """The settings for photos with this number of pixels."""
        if self.per_pixel is None:
            return self
        return self.model_copy(update={"most": max(min(self.most, round(self.per_pixel * pixels)), 4)})


class ConsistencySettings(FusionSettings):
    """Normals pulled to the fused normals of the surfels' own depths, if no prior gives normals."""

    weight: float = Field(
        default=0.1, ge=0, description="Weight of opacity - (sum of w n) . N in the loss; 0 leaves it out."
    )
    every: int = Field(default=7500, ge=1, description="Steps between two fusions of all views' depths.")
    sigma: Smoothing = 3.0


class RadianceSettings(Settings):
    """Stage 1: geometry and radiance, with learning rates of Adam."""

    steps: int = Field(default=30_000, ge=0, description="Steps; each renders one view.")
    position_rate: float = Field(
        default=1.6e-4, gt=0, description="Initial position learning rate relative to the scene's extent."
    )
    position_rate_final: float = Field(
        default=1.6e-6, gt=0, description="Final position learning rate; the decay is exponential."
    )
    opacity_rate: float = Field(default=0.05, gt=0, description="Learning rate of the opacities, as logits.")
    sh_rate: float = Field(default=2.5e-3, gt=0, description="Learning rate of the harmonic of degree 0.")
    sh_rest_rate: float = Field(default=1.25e-4, gt=0, description="Learning rate of the other harmonics.")
    rotation_rate: float = Field(default=1e-3, gt=0, description="Learning rate of the quaternions.")
    scale_rate: float = Field(default=5e-3, gt=0, description="Learning rate of the scales, as logarithms.")
    sh_degree: int = Field(default=3, ge=0, le=3, description="Highest degree of the radiance's harmonics.")
    sh_every: int = Field(default=1000, ge=1, description="Steps between two degrees of the harmonics.")
    ssim: float = Field(
        default=0.2, ge=0, le=1, description="Weight of 1 - SSIM; that of L1 is 1 minus this."
    )
    normal: float = Field(
        default=0.5, ge=0, description="lambda_n: weight of the same loss on a prior's normals."
    )
    mask: float = Field(default=0.2, ge=0, description="Weight of |opacity - mask|, where views have masks.")
    background: Literal["black", "white", "random"] = Field(
        default="black", description="Background behind surfels and masked subjects."
    )
    coarse: tuple[Share, ...] = Field(
        default=(),
        description="Shares of the steps that see photos reduced, smallest first: [0.2, 0.3] takes a fifth "
        "of them at a quarter of the size, then three tenths at half of it; [] takes all whole.",
    )
    exposures: bool = Field(
        default=True,
        description="Find the exposure and white balance of each photo; false takes all as exposed alike.",
    )
    density: DensitySettings = Field(default=DensitySettings(), description="Surfels added and removed.")
    consistency: ConsistencySettings = Field(
        default=ConsistencySettings(),
        description="Normals pulled to those that all views' depths agree on, where no prior gives any.",
    )

    @field_validator("coarse")
    @classmethod
    def _some_are_whole(cls, shares: tuple[float, ...]) -> tuple[float, ...]:
        if sum(shares) >= 1:
            raise ValueError("shares of 1 and more leave no step for the photos as they are")
        return shares

    def scaled(self, factor: float, place: Place = "anywhere") -> RadianceSettings:
        """The same schedule in ``factor`` times as many steps; a step number of 0 stays 0.

        Positions and rotations are learnt at 1 / sqrt(factor) of their rates, unless surfels begin in place;
        positions at the square root of that where they begin near their place. A step of Adam is about as
        long as its rate, whatever the gradient, and views pull to and fro: n steps reach rate x sqrt(n), and
        this reach is kept. (The same law as for batches: k views a step in 1/k of the steps want sqrt(k)
        times Adam's rate; Malladi et al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient
        Algorithms"; Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training".) The other parameters
        begin near where they end, and keep their rates.
        """
        density = _scaled(self.density, ("start", "end", "every", "prune_every", "reset_every"), factor)
        consistency = _scaled(self.consistency, ("every",), factor)
        moving, turning = _FASTER[place]
        rates = {
            "position_rate": self.position_rate / factor**moving,
            "position_rate_final": self.position_rate_final / factor**moving,
            "rotation_rate": self.rotation_rate / factor**turning,
        }
        schedule = _scaled(self, ("steps", "sh_every"), factor)
        return schedule.model_copy(update={"density": density, "consistency": consistency, **rates})


class MaterialSettings(Settings):
    """Stage 2: base color, roughness and metallic from the priors, geometry frozen."""

    steps: int = Field(default=7000, ge=0, description="Steps; each renders one view.")
    rate: float = Field(default=0.01, gt=0, description="Initial learning rate of all three, Adam's.")
    decay: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="Final learning rate over the initial one; the decay is exponential.",
    )
    ssim: float = Field(
        default=0.2, ge=0, le=1, description="Weight of 1 - SSIM; that of L1 is 1 minus this."
    )

    def scaled(self, factor: float) -> MaterialSettings:
        """The same in ``factor`` times as many steps."""
        return _scaled(self, ("steps",), factor)


class ReconstructionSettings(Settings):
    """Reconstruction of surfels: the paper's, a tenth as long, with what so short a schedule needs."""

    initial: InitialSettings = Field(default=InitialSettings(), description="Source of the first surfels.")
    radiance: RadianceSettings = Field(default=RadianceSettings(), description="Stage 1.")
    materials: MaterialSettings = Field(default=MaterialSettings(), description="Stage 2.")
    indoors: Indoors = Field(
        default="auto",
        description="Photos taken in a room: where none shows what bounds it, such as a ceiling, surfels of "
        "the colour near by close it, so that no light comes in, and surfels that show the sky in windows "
        "are taken out, so that it does there; auto: where surfaces stand around the cameras on all sides, "
        "and higher than trees or houses would.",
    )
    steps_scaler: float = Field(
        default=0.1,
        gt=0,
        le=100,
        description="Factor on every number of steps of both stages: 0.1 takes 3,000 + 700. "
        "Rates of position and rotation are divided by its square root, but for surfels from depth maps.",
    )
    checkpoint_every: int = Field(default=500, ge=1, description="Steps between two checkpoints.")
    seed: int = Field(default=0, description="Root of all random numbers.")


class FitSettings(Settings):
    """Fit of an environment map: about half a minute on two CPU cores for a small scene."""

    resolution: int = Field(default=64, ge=2, description="Texels along a face edge of the cubemap.")
    steps: int = Field(default=1000, ge=1, description="Updates of the cubemap.")
    rays: int = Field(default=8, ge=2, multiple_of=2, description="Shadow rays per point, even.")
    pixels: int = Field(default=1024, ge=1, description="Surface points per step, all of one view.")
    learning_rate: float = Field(
        default=0.1, gt=0, description="Initial learning rate of Adam, in log radiance."
    )
    final_learning_rate: float = Field(
        default=0.01, gt=0, description="Final learning rate; the decay is exponential."
    )
    estimator: Estimator = Field(
        default=FINAL.estimator, description="ratio, or plain, the paper's sum, which needs far more rays."
    )
    two_sided: bool = Field(
        default=FINAL.two_sided,
        description="Back faces block shadow rays beyond two spacings; false: never, as in the paper.",
    )
    brdf: Brdf = Field(
        default=FINAL.brdf,
        description="Material that the light's scale is fitted with: conserving, or lambert, the paper's.",
    )
    coarsest: int = Field(
        default=4,
        ge=2,
        description="Texels along a face edge of the coarsest level that log radiance is a sum of; "
        "resolution or more fits each texel by itself, which gives the same irradiance and a noisy map.",
    )
    scale_steps: int = Field(default=200, ge=0, description="Updates of the scale; 0 leaves it at 1.")
    scale_pixels: int = Field(
        default=1 << 14,
        ge=1,
        description="Maximum number of pixels of a photo that the scale is fitted to; larger are reduced.",
    )
    scale_rays: int = Field(
        default=16, ge=2, multiple_of=2, description="Shadow rays per pixel of these photos, even."
    )
    split_sum_resolution: Literal[64, 128, 256, 512, 1024] = Field(
        default=512, description="Texels along a face edge of the prefiltered light."
    )
    seed: int = Field(default=0, description="Root of every random number.")

    def estimation(self, rays: int, *, filtered: bool = False) -> Estimation:
        """Estimation for rendering surfels in the light, consistent with the fit's."""
        return Estimation(
            rays=rays,
            estimator=self.estimator,
            two_sided=self.two_sided,
            brdf=self.brdf,
            filtered=filtered,
        )


def _scaled(settings: Model, names: tuple[str, ...], factor: float) -> Model:
    values = {name: getattr(settings, name) for name in names}
    return settings.model_copy(
        update={name: max(round(value * factor), 1) if value else 0 for name, value in values.items()}
    )

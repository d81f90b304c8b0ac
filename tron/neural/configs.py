"""Settings of the neural renderers, stored in the weights file. Loads no torch.

``--help`` and ``--cfg`` of tron-train show them, so that neither waits for torch and diffusers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from tron.shards.schema import GUIDANCE, guidance_members

PAPER_GUIDANCE = ("pbr", "irradiance")
"""Guidance of the paper's network: direct light alone."""
AUTO = "auto"
MEAN = "mean"
"""Value of ``skip`` for a network that starts from the mean of all latents."""
BEST_FIRST = ("lit", "pbr")
"""Default start buffers: the first of these among the network's guidance."""


def check_weights(weights: Mapping[str, float], guidance: Sequence[str]) -> None:
    """ValueError unless each name of the guidance, and none else, has a weight that `check_sizes` takes."""
    if unknown := sorted(set(weights) - set(guidance)):
        raise ValueError(f"weights name '{unknown[0]}': the network is given {', '.join(guidance)}")
    if missing := [name for name in guidance if name not in weights]:
        raise ValueError(f"weights lack '{missing[0]}': the network is given {', '.join(guidance)}")
    check_sizes(weights)


def check_sizes(weights: Mapping[str, float]) -> None:
    """ValueError unless the weights are finite, >= 0, and not all 0."""
    for name, weight in weights.items():
        if not 0 <= weight < math.inf:
            raise ValueError(f"the weight of '{name}' is {weight}: give a number of 0 or more")
    if not any(weights.values()):
        raise ValueError("all weights are 0: the network would be given nothing")


class GuidedConfig(BaseModel):
    """Settings of every renderer, stored in the weights file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    OTHER_STARTS: ClassVar[tuple[str, ...]] = ()

    guidance: tuple[str, ...] = Field(
        default=GUIDANCE, description="Members of a clip that are its input, in order."
    )
    skip: str = Field(
        default=AUTO,
        validate_default=True,
        description="Member of guidance that the network's output is added to; auto: lit where it is among "
        "them, else pbr, else the first.",
    )
    window: int = Field(default=1, ge=1, description="Frames that render_clip hands over at once.")

    @field_validator("guidance")
    @classmethod
    def _colours(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        there = guidance_members()
        if not names or len(set(names)) < len(names) or not set(names) <= set(there):
            raise ValueError(f"guidance is one or more of {', '.join(there)}")
        return names

    @field_validator("skip")
    @classmethod
    def _start(cls, name: str, info: ValidationInfo) -> str:
        guidance = info.data.get("guidance")
        if guidance is None:  # refused already
            return name
        if name == AUTO:
            return next((best for best in BEST_FIRST if best in guidance), guidance[0])
        starts = (*guidance, *cls.OTHER_STARTS)
        if name not in starts:
            raise ValueError(f"skip is one of {', '.join((AUTO, *starts))}")
        return name


class BackboneConfig(BaseModel):
    """Shape of a CosmosTransformer3DModel; the defaults give a tiny model that trains in minutes on a CPU.

    Attributes:
        padding_channel: the published weights expect a padding mask as one more input channel; it is always
            zero.
        cross_attention: "frozen" keeps the text branch as loaded; "none" leaves it out. With the null text
            embedding its output is exactly zero either way, so what differs is only memory and time.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["cosmos"] = "cosmos"
    heads: int = Field(default=3, ge=1)
    head_dim: int = Field(default=32, ge=6)
    layers: int = Field(default=4, ge=1)
    mlp_ratio: float = Field(default=4.0, gt=0)
    text_embed_dim: int = Field(default=16, ge=1)
    adaln_lora_dim: int = Field(default=32, ge=1)
    patch: tuple[int, int, int] = (1, 1, 1)
    max_size: tuple[int, int, int] = (64, 512, 512)
    rope_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    padding_channel: bool = False
    cross_attention: Literal["frozen", "none"] = "none"


Width = Annotated[int, Field(ge=1, le=4096)]
Depth = Annotated[int, Field(ge=0, le=64)]


class UNetConfig(BaseModel):
    """Shape of a UNet (`unet.py`)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["unet"] = "unet"
    patch: Literal[1, 2, 4] = Field(
        default=2, description="Side of the squares of latent pixels that become one: the finest level."
    )
    widths: tuple[Width, ...] = Field(
        default=(32, 64, 128, 128),
        min_length=1,
        max_length=8,
        description="Channels of each level, finest first.",
    )
    blocks: tuple[Depth, ...] = Field(
        default=(2, 2, 2, 2), description="Blocks of each level on the way down."
    )
    blocks_up: tuple[Depth, ...] = Field(
        default=(1, 1, 1), description="Blocks of each level but the coarsest on the way up, finest first."
    )
    spatial: Literal["depthwise", "dense"] = Field(
        default="depthwise",
        description="3 x 3 convolutions of a block: depthwise sees each channel alone, dense all of them.",
    )
    attention: bool = Field(
        default=False,
        description="Simplified channel attention: means over the whole picture scale the channels. What a "
        "pixel becomes then depends on the size of the picture, which in training is a crop's.",
    )
    temporal: bool = Field(
        default=True,
        description="Paths between frames, which begin at zero and are skipped for single frames.",
    )

    @model_validator(mode="after")
    def _levels(self) -> UNetConfig:
        levels = len(self.widths)
        if len(self.blocks) != levels or len(self.blocks_up) != levels - 1:
            raise ValueError(
                f"{levels} widths go with {levels} numbers in blocks and {levels - 1} in blocks_up, not "
                f"{len(self.blocks)} and {len(self.blocks_up)}"
            )
        return self


def _kind(backbone: Any) -> str:
    """Which backbone is described; files from before there were two do not say."""
    if isinstance(backbone, Mapping):
        return str(backbone.get("kind", "cosmos"))
    return getattr(backbone, "kind", "cosmos")


AnyBackbone = Annotated[
    Annotated[BackboneConfig, Tag("cosmos")] | Annotated[UNetConfig, Tag("unet")],
    Discriminator(_kind),
]


class RendererConfig(GuidedConfig):
    """Parts of a NeuralRenderer, stored in the weights file. ``skip=mean`` starts from the latents' mean."""

    OTHER_STARTS: ClassVar[tuple[str, ...]] = (MEAN,)

    codec: str = Field(
        default="block_dct", description="Video to latents, a name of tron.neural.codecs.registry."
    )
    fusion: Literal["concat", "average"] = Field(
        default="concat",
        description="concat gives the transformer all latents; average their mean, which keeps the input "
        "width that published weights expect (the paper's choice, 3 dB worse for the tiny model).",
    )
    skip_blur: float = Field(
        default=0.0,
        ge=0,
        le=2,
        description="Deviation in pixels of a Gaussian that the start is filtered by first: guidance is "
        "sampled once a pixel, a photograph is a mean over it. 0: none.",
    )
    skip_kernel: Literal[0, 3, 5, 7] = Field(
        default=0,
        description="Side in pixels of kernels that the network predicts, one for each pixel, to filter the "
        "start by; they begin as the Gaussian of skip_blur. For codec=pixels. 0: that Gaussian.",
    )
    skip_detail: str | None = Field(
        default=None,
        description="Member of guidance, such as albedo, whose detail is given back to the start: what those "
        "kernels take from it, each pixel and channel in a share that the network predicts, 0 at first.",
    )
    skip_holes: int = Field(
        default=0,
        ge=0,
        le=8,
        description="Pixels between the points of a second predicted kernel of that side, which filters what "
        "the first left and begins as nothing: noise that is wider than the first. 0: none.",
    )
    scales: Literal[1, 2] = Field(
        default=1,
        description="2: the network draws the picture at half its size too, and what is coarse is taken from "
        "there. The same weights; for codec=pixels.",
    )
    sigma: float | None = Field(
        default=None,
        gt=0,
        description="Noise level of the single denoising step (paper: 250 of 1000, i.e. 0.25): t = sigma / "
        "(1 + sigma), input (1 - t) z, result (1 - t) z - t net(...). None: the plain residual z + net(z).",
    )
    weights: dict[str, float] | None = Field(
        default=None,
        description="Weight of each buffer's latent, by name: average gives the backbone their weighted sum, "
        "concat each times its weight and their number; null: equal weights. The start is not weighed, "
        "unless it is the mean.",
    )
    backbone: AnyBackbone = Field(
        default=BackboneConfig(), description="Network between the latents; kind: cosmos or unet."
    )

    @field_validator("weights")
    @classmethod
    def _weights(cls, weights: dict[str, float] | None, info: ValidationInfo) -> dict[str, float] | None:
        if weights is not None and "guidance" in info.data:
            check_weights(weights, info.data["guidance"])
        return weights

    @model_validator(mode="after")
    def _filter(self) -> RendererConfig:
        if self.skip_blur and self.skip == MEAN:
            raise ValueError("skip_blur filters one buffer: skip=mean has none, name one of guidance")
        if self.skip_kernel and (self.codec != "pixels" or not self.skip_blur):
            raise ValueError("skip_kernel goes with codec=pixels and a skip_blur above 0, which it begins as")
        if self.skip_holes and not self.skip_kernel:
            raise ValueError("skip_holes are those of a second kernel: they go with a skip_kernel")
        if self.scales == 2 and self.codec != "pixels":
            raise ValueError("scales=2 goes with codec=pixels")
        if self.skip_detail is not None and not self.skip_kernel:
            raise ValueError("skip_detail is what kernels take from a buffer: it goes with a skip_kernel")
        if self.skip_detail is not None and self.skip_detail not in self.guidance:
            raise ValueError(f"skip_detail is one of guidance: {', '.join(self.guidance)}")
        return self


COSMOS_0_6B = BackboneConfig(
    heads=20,
    head_dim=64,
    layers=20,
    mlp_ratio=4.0,
    text_embed_dim=1024,
    adaln_lora_dim=256,
    patch=(1, 2, 2),
    max_size=(128, 240, 240),
    rope_scale=(1.0, 4.0, 4.0),
    padding_channel=True,
    cross_attention="frozen",
)
"""Cosmos-Predict2 0.6B, 597.5 M parameters with 16 latent channels."""


class CosmosConfig(RendererConfig):
    """The paper's renderer: published backbone and codec, one step at its noise level, five frames."""

    guidance: tuple[str, ...] = PAPER_GUIDANCE
    skip: str = MEAN
    window: int = Field(default=5, ge=1)
    codec: str = "wan"
    fusion: Literal["concat", "average"] = "average"
    sigma: float | None = Field(default=0.25, gt=0)
    backbone: BackboneConfig = COSMOS_0_6B


class UNetRendererConfig(RendererConfig):
    """Settings of a renderer with a UNet on pixels."""

    codec: str = "pixels"
    backbone: UNetConfig = UNetConfig()


class PixelMLPConfig(GuidedConfig):
    """Width and number of hidden layers."""

    width: int = Field(default=64, ge=1)
    hidden_layers: int = Field(default=3, ge=1)

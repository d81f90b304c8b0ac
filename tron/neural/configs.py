"""Settings of the neural renderers; they travel inside the weights file. Loads no torch.

``--help`` and ``--cfg`` of tron-train show them, so that neither waits for torch and diffusers.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from tron.shards.schema import GUIDANCE, light_members

PAPER_GUIDANCE = ("pbr", "irradiance")
"""Guidance of the paper's network: direct light alone."""
AUTO = "auto"
MEAN = "mean"
"""Start of a network that adds to the mean of all latents."""
BEST_FIRST = ("lit", "pbr")
"""Buffers that a network starts from unless told otherwise: the first of them that it is given."""


class GuidedConfig(BaseModel):
    """Settings of every renderer; they travel inside the weights file."""

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
        there = light_members()
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
    """Shape of a CosmosTransformer3DModel; the defaults are the tiny one that trains in minutes on a CPU.

    Attributes:
        padding_channel: the published weights expect a padding mask as one more input channel; it is always
            zero.
        cross_attention: "frozen" keeps the text branch as loaded; "none" leaves it out. With the null text
            embedding its output is exactly zero either way, so what differs is only memory and time.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

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


class RendererConfig(GuidedConfig):
    """Parts of a NeuralRenderer; it travels inside the weights file. ``skip`` may be mean: of all latents."""

    OTHER_STARTS: ClassVar[tuple[str, ...]] = (MEAN,)

    codec: str = Field(default="block_dct", description="Video to latents, a name of tron.neural.codecs.")
    fusion: Literal["concat", "average"] = Field(
        default="concat",
        description="concat gives the transformer all latents; average their mean, which keeps the input "
        "width that published weights expect (the paper's choice, 3 dB worse for the tiny model).",
    )
    sigma: float | None = Field(
        default=None,
        gt=0,
        description="Noise level of the single denoising step (paper: 250 of 1000, i.e. 0.25): t = sigma / "
        "(1 + sigma), input (1 - t) z, result (1 - t) z - t net(...). None: the plain residual z + net(z).",
    )
    backbone: BackboneConfig = BackboneConfig()


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
    """Renderer of the paper: published backbone and codec, one step at its noise level, five frames."""

    guidance: tuple[str, ...] = PAPER_GUIDANCE
    skip: str = MEAN
    window: int = Field(default=5, ge=1)
    codec: str = "wan"
    fusion: Literal["concat", "average"] = "average"
    sigma: float | None = Field(default=0.25, gt=0)
    backbone: BackboneConfig = COSMOS_0_6B


class PixelMLPConfig(GuidedConfig):
    """Width and number of hidden layers."""

    width: int = Field(default=64, ge=1)
    hidden_layers: int = Field(default=3, ge=1)

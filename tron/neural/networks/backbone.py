"""The transformer between the latents: diffusers' Cosmos-Predict2 DiT, tiny or with its published weights."""

from __future__ import annotations

from typing import Any

import torch
from diffusers.models.transformers.transformer_cosmos import CosmosTransformer3DModel
from torch import Tensor, nn

from tron.neural.configs import BackboneConfig


class NoCrossAttention(nn.Module):
    """Cross-attention over a zero token without biases: zero."""

    def forward(self, hidden_states: Tensor, *_args: Any, **_kwargs: Any) -> Tensor:
        """Return zeros of the hidden states' shape."""
        return torch.zeros_like(hidden_states)


class _NoModulation(nn.Module):
    """Stands for the norm in front of an absent cross-attention: hands on its input and a gate of one."""

    def forward(self, hidden_states: Tensor, *_args: Any, **_kwargs: Any) -> tuple[Tensor, Tensor]:
        return hidden_states, hidden_states.new_ones(())


def transformer(config: BackboneConfig, in_channels: int, out_channels: int) -> CosmosTransformer3DModel:
    """Build the transformer with diffusers' own initialisation; channels are numbers of latent channels."""
    return CosmosTransformer3DModel(
        in_channels=in_channels + int(config.padding_channel),
        out_channels=out_channels,
        num_attention_heads=config.heads,
        attention_head_dim=config.head_dim,
        num_layers=config.layers,
        mlp_ratio=config.mlp_ratio,
        text_embed_dim=config.text_embed_dim,
        adaln_lora_dim=config.adaln_lora_dim,
        max_size=config.max_size,
        patch_size=config.patch,
        rope_scale=config.rope_scale,
        # diffusers concatenates the mask with torchvision, which need not be there; ours is a zero channel.
        concat_padding_mask=False,
        extra_pos_embed_type=None,
    )


class Backbone(nn.Module):
    """Latents and a fixed time step in, the transformer's raw output out; the text is always null."""

    def __init__(self, config: BackboneConfig, in_channels: int, out_channels: int):
        super().__init__()
        self.config = config
        self.transformer = transformer(config, in_channels, out_channels)
        self._initialise()
        self.leave_out_text()

    def _initialise(self) -> None:
        """Start from the identity: a zero output layer, and modulations small enough not to disturb it."""
        nn.init.zeros_(self.transformer.proj_out.weight)
        for name, parameter in self.transformer.transformer_blocks.named_parameters():
            if name.endswith("linear_2.weight"):
                nn.init.normal_(parameter, std=0.02)

    def leave_out_text(self) -> None:
        """Freeze the text branch (24% of the weights), or leave it out if the config says so.

        Keys and values of a zero token without biases are zero, so the branch adds exactly nothing and gets
        no gradient; freezing it also lets DDP run with find_unused_parameters=False.
        """
        for block in self.transformer.transformer_blocks:
            if self.config.cross_attention == "none":
                block.attn2, block.norm2 = NoCrossAttention(), _NoModulation()
            else:
                block.attn2.requires_grad_(False)
                block.norm2.requires_grad_(False)

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D: attention and feed-forward of every block."""
        blocks = self.transformer.transformer_blocks
        return [p for name, p in blocks.named_parameters() if ".attn1.to_" in name or ".ff." in name]

    def temporal_weights(self) -> dict[str, nn.Parameter]:
        """Return nothing: the same attention looks over space and time."""
        return {}

    def forward(self, latent: Tensor, timestep: float) -> Tensor:
        """(B, in_channels, T, h, w) -> (B, out_channels, T, h, w), any h and w that the patch divides."""
        batch = latent.shape[0]
        if self.config.padding_channel:
            latent = torch.cat([latent, torch.zeros_like(latent[:, :1])], 1)
        return self.transformer(
            latent,
            timestep=latent.new_full((batch,), timestep),
            encoder_hidden_states=latent.new_zeros(batch, 1, self.config.text_embed_dim),
            return_dict=False,
        )[0]

"""The networks of RGB->X, assembled from diffusers' and transformers' classes (see :mod:`tron.priors.rgbx`).

Its own pipeline class comes with the authors' program, not with diffusers. Loading reads local files alone:
no network, no code from the checkpoint, no pickled weights.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from transformers import CLIPTextModel, CLIPTokenizer

from tron.errors import TronError
from tron.priors.rgbx_checkpoint import CONFIGS, MEND, WEIGHTED


@dataclass(frozen=True, eq=False)
class RgbXModel:
    """Call it with a photo and a prompt; see :meth:`__call__`."""

    unet: Any  # UNet2DConditionModel; diffusers' types name neither configurations nor outputs
    vae: Any  # AutoencoderKL
    text_encoder: Any  # CLIPTextModel
    tokenizer: Any  # CLIPTokenizer
    scheduler: Any  # DDIMScheduler

    @classmethod
    def load(cls, folder: Path, device: str, dtype: str) -> RgbXModel:
        """Read a checkpoint that :func:`check_checkpoint` has passed, onto a device.

        Raises:
            TronError: a part is damaged or not what RGB->X is made of, or the device is not there.
        """
        kind = getattr(torch, dtype)
        fast = {"low_cpu_mem_usage": False}  # the other way needs a package of its own
        unet = _load(UNet2DConditionModel, folder, "unet", torch_dtype=kind, **fast)
        vae = _load(AutoencoderKL, folder, "vae", torch_dtype=kind, **fast)
        text_encoder = _load(CLIPTextModel, folder, "text_encoder", dtype=kind)
        tokenizer = _load(CLIPTokenizer, folder, "tokenizer")
        if unet.config.in_channels != 2 * vae.config.latent_channels:
            raise TronError(
                f"unet takes {unet.config.in_channels} channels, RGB->X twice the autoencoder's "
                f"{vae.config.latent_channels}",
                folder,
                MEND,
            )
        try:
            for network in (unet, vae, text_encoder):
                network.requires_grad_(False).eval().to(torch.device(device))
        except (RuntimeError, AssertionError) as error:
            raise TronError(f"device {device!r}: {_first_line(error)}", mend="use cpu") from error
        return cls(unet, vae, text_encoder, tokenizer, _scheduler(folder))

    @torch.inference_mode()
    def __call__(self, photo: np.ndarray, prompt: str, steps: int, seed: int) -> np.ndarray:
        """One map of a photo.

        Args:
            photo: (H, W, 3) linear in [0, 1]; sides that are multiples of 8.
            prompt: which map, in the model's words.
            steps: of denoising.
            seed: of the noise, drawn on the CPU, so that it is the same wherever the model runs.

        Returns:
            (H, W, 3) float32, signed: 2 x - 1 for what lies in [0, 1].
        """
        device, dtype = self.unet.device, self.unet.dtype
        pixels = torch.from_numpy(np.ascontiguousarray(2 * photo - 1)).movedim(-1, 0)[None].to(device, dtype)
        scale = self.vae.config.scaling_factor
        condition = self.vae.encode(pixels).latent_dist.mode() * scale
        words = self._embedded(prompt)
        noise = torch.randn(condition.shape, generator=torch.Generator().manual_seed(seed))
        latent = (noise * self.scheduler.init_noise_sigma).to(device, dtype)
        self.scheduler.set_timesteps(steps)
        for step in self.scheduler.timesteps:
            sample = torch.cat([self.scheduler.scale_model_input(latent, step), condition], dim=1)
            predicted = self.unet(sample, step.to(device), encoder_hidden_states=words).sample
            latent = self.scheduler.step(predicted, int(step), latent).prev_sample
        decoded = self.vae.decode(latent / scale).sample[0].movedim(0, -1)
        return decoded.float().cpu().numpy()

    def _embedded(self, prompt: str) -> torch.Tensor:
        longest = self.text_encoder.config.max_position_embeddings
        tokens = self.tokenizer(
            prompt, padding="max_length", max_length=longest, truncation=True, return_tensors="pt"
        )
        return self.text_encoder(tokens.input_ids.to(self.unet.device))[0]


def _load(part: Any, folder: Path, name: str, **options: Any) -> Any:
    options["local_files_only"] = True
    if name in WEIGHTED:
        options["use_safetensors"] = True
        files = [file.name for file in (folder / name).glob("*.safetensors")]
        if all(".fp16." in file for file in files):
            options["variant"] = "fp16"
    try:
        return part.from_pretrained(folder / name, **options)
    except Exception as error:  # what damaged files raise differs from library to library
        raise TronError(f"cannot read {name} of RGB->X: {_first_line(error)}", folder, MEND) from error


def _scheduler(folder: Path) -> DDIMScheduler:
    try:
        config = json.loads((folder / "scheduler" / CONFIGS["scheduler"]).read_text())
        scheduler: Any = DDIMScheduler.from_config(
            config, rescale_betas_zero_snr=True, timestep_spacing="trailing"
        )
    except Exception as error:
        raise TronError(f"cannot read scheduler of RGB->X: {_first_line(error)}", folder, MEND) from error
    if scheduler.config.prediction_type != "v_prediction":
        # With no signal left at the first step, noise says nothing about the image.
        raise TronError(f"scheduler predicts {scheduler.config.prediction_type}, RGB->X velocities", folder)
    return scheduler


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]

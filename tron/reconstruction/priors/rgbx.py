"""RGB->X: base color, normals, roughness, metallicity and irradiance of a photo, by a diffusion model.

Zeng et al. 2024, "RGB<->X: Image Decomposition and Synthesis Using Material- and Lighting-aware Diffusion
Models". The model is a Stable Diffusion 2 network whose input is the noisy latent beside the photo's latent;
the text prompt says which map is wanted. What follows from its authors' program (zheng95z/rgbx): the prompts;
the photo in linear light (a curve of 2.2), not scaled or tone-mapped further when it is an 8-bit one; the
mode of the photo's latent, times the autoencoder's scaling factor; no guidance; DDIM with trailing steps and
zero terminal signal-to-noise; colours come out linear, normals signed in camera space, scalars in the first
channel.

The weights are not ours and are never fetched: give the path of a local copy of
huggingface.co/zheng95z/rgb-to-x, and see its license. The networks are assembled from the classes of
diffusers and transformers (extra ``rgbx``), from local files: no network, no code from the checkpoint, no
pickled weights.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from pydantic import Field

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.color import MIDDLE_GREY, luminance
from tron.errors import TronError
from tron.reconstruction.priors.prior import CONFIG, MapPrior, Maps, resized, world_normals
from tron.seeds import integer

Dtype = Literal["float32", "float16", "bfloat16"]

PROMPTS = {
    "base_color": "Albedo (diffuse basecolor)",
    "normal": "Camera-space Normal",
    "roughness": "Roughness",
    "metallic": "Metallicness",
    "irradiance": "Irradiance (diffuse lighting)",
}

MEND = "give a local copy of huggingface.co/zheng95z/rgb-to-x as checkpoint; nothing is downloaded"
CONFIGS = {
    "unet": "config.json",
    "vae": "config.json",
    "text_encoder": "config.json",
    "tokenizer": "tokenizer_config.json",
    "scheduler": "scheduler_config.json",
}
WEIGHTED = ("unet", "vae", "text_encoder")
NEEDED = ("diffusers", "transformers")

_CURVE = 2.2  # the authors' display curve; not sRGB's, which the model was not trained with
_SCHEDULE = 1000  # steps of noise that the model was trained with
_MULTIPLE = 8  # pixels a latent


@pydantic.dataclasses.dataclass(frozen=True, config=CONFIG)
class RgbX(MapPrior):
    """The RGB->X model from a local checkpoint in diffusers' layout.

    Attributes:
        checkpoint: folder with unet, vae, text_encoder, tokenizer and scheduler; weights in safetensors.
        steps: denoising steps a map, a divisor of 1000.
        seed: root of the noise; each view and map has a stream of its own.
        device: torch's name of where it runs.
        dtype: of the weights and of the arithmetic.
        longest_side: photos are brought to this many pixels along their longer side, as the authors do.

    Raises:
        ValidationError: an option outside its range.
        TronError: steps that do not divide 1000, no checkpoint, or one that lacks a part.
    """

    checkpoint: str | Path | None = None
    steps: int = 50
    seed: int = 0
    device: str = "cpu"
    dtype: Dtype = "float32"
    longest_side: Annotated[int, Field(ge=_MULTIPLE)] = 1000

    def __post_init__(self) -> None:
        # DDIM with trailing steps reaches the clean image only if its steps are all of one length.
        if self.steps < 1 or _SCHEDULE % self.steps:
            raise TronError(f"steps is {self.steps}", mend=f"give a divisor of {_SCHEDULE}, such as 20 or 50")
        lacking = [name for name in NEEDED if find_spec(name) is None]
        if lacking:
            raise TronError(
                f"the prior rgbx needs {lacking[0]}, which is not installed",
                mend="install tron-relight[rgbx]",
            )
        check_checkpoint(self.checkpoint)  # told before photos are posed

    def fields(self, capture: Capture) -> Mapping[str, str]:  # noqa: ARG002 (the protocol's)
        """All but a sky mask; nothing is loaded."""
        how = dict.fromkeys(PROMPTS, f"RGB->X, {self.steps} steps")
        how["irradiance"] += ", at most 1 and of unknown scale"
        return how

    def prepare(self, capture: Capture, fields: Collection[str]) -> Maps:  # noqa: ARG002 (the protocol's)
        """Load the model; it is freed with the function that is returned.

        Raises:
            TronError: a part of the checkpoint cannot be loaded.
        """
        model = RgbXModel.load(check_checkpoint(self.checkpoint), self.device, self.dtype)

        def maps(view: View) -> Mapping[str, Pixels]:
            width, height = self._size(view.camera.width, view.camera.height)
            photo = resized(linear_photo(view), width, height)
            return {field: self._map(model, field, photo, view) for field in PROMPTS if field in fields}

        return maps

    def _size(self, width: int, height: int) -> tuple[int, int]:
        scale = self.longest_side / max(width, height)
        width, height = (max(int(side * scale) // _MULTIPLE, 1) * _MULTIPLE for side in (width, height))
        return width, height

    def _map(self, model: RgbXModel, field: str, photo: np.ndarray, view: View) -> np.ndarray:
        seed = integer(self.seed, "prior", "rgbx", view.name, field, bits=63)
        pixels = model(photo, PROMPTS[field], self.steps, seed)
        width, height = view.camera.width, view.camera.height
        if field == "normal":
            unit = world_normals(pixels, view.camera, "camera_opengl")
            return world_normals(resized(unit, width, height), view.camera, "world")
        unsigned = (pixels / 2 + 0.5).clip(0, 1)
        if field in ("roughness", "metallic"):
            unsigned = unsigned[..., 0]
        return resized(unsigned, width, height)


def linear_photo(view: View) -> np.ndarray:
    """The view's image (H, W, 3) in [0, 1] as the model knows photos: linear light.

    Display images lose a curve of 2.2. Linear ones are exposed so that the mean of their log luminance is
    middle grey, and clipped, as the authors do with EXR files.
    """
    image = view.read()
    if view.space == "display":
        return image**_CURVE
    mean = np.exp(np.log(np.maximum(luminance(image), 1e-6)).mean())
    return (image * (MIDDLE_GREY / mean)).clip(0, 1)


def check_checkpoint(checkpoint: str | Path | None) -> Path:
    """The checkpoint's folder, if all its parts are there.

    Raises:
        TronError: no folder, or the first part that is missing or has no safetensors.
    """
    if not checkpoint:
        raise TronError("the prior rgbx has no checkpoint", mend=MEND)
    folder = Path(checkpoint)
    if not folder.is_dir():
        raise TronError("checkpoint of RGB->X not found", folder, MEND)
    for part, config in CONFIGS.items():
        if not (folder / part / config).is_file():
            raise TronError(f"the RGB->X checkpoint lacks {part}/{config}", folder, MEND)
        if part in WEIGHTED and not any((folder / part).glob("*.safetensors")):
            mend = "weights are read from safetensors alone: convert pickled ones first"
            raise TronError(f"the RGB->X checkpoint has no safetensors in {part}", folder, mend)
    return folder


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
        import torch
        from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
        from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
        from transformers import CLIPTextModel, CLIPTokenizer

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
        import torch

        with torch.inference_mode():
            device, dtype = self.unet.device, self.unet.dtype
            pixels = (
                torch.from_numpy(np.ascontiguousarray(2 * photo - 1)).movedim(-1, 0)[None].to(device, dtype)
            )
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

    def _embedded(self, prompt: str) -> Any:
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


def _scheduler(folder: Path) -> Any:
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler

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

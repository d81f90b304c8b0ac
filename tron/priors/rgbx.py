"""RGB->X: base color, normals, roughness, metallicity and irradiance of a photo, by a diffusion model.

Zeng et al. 2024, "RGB<->X: Image Decomposition and Synthesis Using Material- and Lighting-aware Diffusion
Models". The model is a Stable Diffusion 2 network whose input is the noisy latent beside the photo's latent;
the text prompt says which map is wanted. What follows from its authors' program (zheng95z/rgbx): the prompts;
the photo in linear light (a curve of 2.2), not scaled or tone-mapped further when it is an 8-bit one; the
mode of the photo's latent, times the autoencoder's scaling factor; no guidance; DDIM with trailing steps and
zero terminal signal-to-noise; colours come out linear, normals signed in camera space, scalars in the first
channel.

The weights are not ours and are never fetched: give the path of a local copy of
huggingface.co/zheng95z/rgb-to-x, and see its license.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import pydantic
from pydantic import Field

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.color import luminance
from tron.errors import TronError
from tron.priors.map_geometry import resized, world_normals
from tron.priors.prior import CONFIG, Maps, Request
from tron.priors.rgbx_checkpoint import check_checkpoint
from tron.seeds import integer

if TYPE_CHECKING:
    from tron.priors.rgbx_model import RgbXModel

Dtype = Literal["float32", "float16", "bfloat16"]

PROMPTS = {
    "base_color": "Albedo (diffuse basecolor)",
    "normal": "Camera-space Normal",
    "roughness": "Roughness",
    "metallic": "Metallicness",
    "irradiance": "Irradiance (diffuse lighting)",
}

_CURVE = 2.2  # the authors' display curve; not sRGB's, which the model was not trained with
_MIDDLE_GREY = 0.18
_SCHEDULE = 1000  # steps of noise that the model was trained with
_MULTIPLE = 8  # pixels a latent


@pydantic.dataclasses.dataclass(frozen=True, config=CONFIG)
class RgbX:
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

    checkpoint: str | None = None
    steps: int = 50
    seed: int = 0
    device: str = "cpu"
    dtype: Dtype = "float32"
    longest_side: Annotated[int, Field(ge=_MULTIPLE)] = 1000

    def __post_init__(self) -> None:
        # DDIM with trailing steps reaches the clean image only if its steps are all of one length.
        if self.steps < 1 or _SCHEDULE % self.steps:
            raise TronError(f"steps is {self.steps}", mend=f"give a divisor of {_SCHEDULE}, such as 20 or 50")
        check_checkpoint(self.checkpoint)  # told before photos are posed

    @property
    def needs_geometry(self) -> frozenset[str]:
        """None: it sees the photo alone."""
        return frozenset()

    def fields(self, capture: Capture) -> Mapping[str, str]:  # noqa: ARG002 (the protocol's)
        """All but a sky mask; nothing is loaded."""
        how = dict.fromkeys(PROMPTS, f"RGB->X, {self.steps} steps")
        how["irradiance"] += ", at most 1 and of unknown scale"
        return how

    def prepare(self, request: Request) -> Maps:
        """Load the model; it is freed with the function that is returned.

        Raises:
            TronError: a part of the checkpoint cannot be loaded.
        """
        from tron.priors.rgbx_model import RgbXModel

        model = RgbXModel.load(check_checkpoint(self.checkpoint), self.device, self.dtype)

        def maps(view: View) -> Mapping[str, Pixels]:
            width, height = self._size(view.camera.width, view.camera.height)
            photo = resized(linear_photo(view), width, height)
            return {
                field: self._map(model, field, photo, view) for field in PROMPTS if field in request.fields
            }

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
    return (image * (_MIDDLE_GREY / mean)).clip(0, 1)

"""RGB->X end to end on a tiny network with random weights, and refused in one line without a whole one."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from tron.captures import Capture, View
from tron.errors import TronError
from tron.reconstruction.priors import RgbX, apply_prior
from tron.reconstruction.priors.rgbx import PROMPTS, RgbXModel, linear_photo
from tron.seeds import generator


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The parts of Stable Diffusion 2 at a thousandth of their size, in diffusers' layout."""
    pytest.importorskip("diffusers", reason="the extra rgbx is not installed")
    import torch
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("rgbx")
    blocks = {"block_out_channels": (8, 8, 8, 8), "norm_num_groups": 4, "layers_per_block": 1}
    UNet2DConditionModel(
        in_channels=8,
        out_channels=4,
        cross_attention_dim=16,
        attention_head_dim=4,
        **blocks,  # type: ignore[arg-type]
    ).save_pretrained(folder / "unet")
    kinds = {"down_block_types": ("DownEncoderBlock2D",) * 4, "up_block_types": ("UpDecoderBlock2D",) * 4}
    AutoencoderKL(latent_channels=4, **kinds, **blocks).save_pretrained(folder / "vae")  # type: ignore[arg-type]
    words = ["<|startoftext|>", "<|endoftext|>", *"abcdefghijklmnopqrstuvwxyz-()"]
    words += [f"{letter}</w>" for letter in "abcdefghijklmnopqrstuvwxyz-()"]
    (folder / "files").mkdir()
    vocabulary, merges = folder / "files" / "vocab.json", folder / "files" / "merges.txt"
    vocabulary.write_text(json.dumps({word: i for i, word in enumerate(words)}))
    merges.write_text("#version: 0.2\n")
    CLIPTokenizer(str(vocabulary), str(merges)).save_pretrained(folder / "tokenizer")
    CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(words),
            hidden_size=16,
            intermediate_size=16,
            num_hidden_layers=1,
            num_attention_heads=2,
            max_position_embeddings=77,
            bos_token_id=0,
            eos_token_id=1,
        )
    ).save_pretrained(folder / "text_encoder")
    DDIMScheduler(
        beta_schedule="scaled_linear", prediction_type="v_prediction", clip_sample=False
    ).save_pretrained(folder / "scheduler")
    shutil.rmtree(folder / "files")
    return folder


def capture(ring, seed: int = 0, width: int = 45, height: int = 30) -> Capture:
    """Random photos, with sides that are no multiples of 8."""
    rng = generator(seed, "priors")
    cameras = ring(2, width, height)
    photos = [rng.uniform(0, 1, (height, width, 3)) for _ in cameras]
    pairs = enumerate(zip(cameras, photos))
    return Capture(tuple(View(f"{i}", camera, photo, "display") for i, (camera, photo) in pairs))


def prior(checkpoint: Path, **changes) -> RgbX:
    return RgbX(**{"checkpoint": str(checkpoint), "steps": 2, "longest_side": 64, **changes})


def test_every_map_fits_the_view_and_the_seed_alone_decides(checkpoint: Path, ring) -> None:
    photos = capture(ring)
    first, again = (apply_prior(photos, prior(checkpoint)) for _ in range(2))
    other = apply_prior(photos, prior(checkpoint, seed=1))
    for a, b, c in zip(first.views, again.views, other.views):
        assert not a.has("sky_mask")
        for field in PROMPTS:
            np.testing.assert_array_equal(a.read(field), b.read(field))  # checked by View: shapes and ranges
        assert np.abs(a.read("base_color") - c.read("base_color")).max() > 1e-3
        length = np.linalg.norm(a.read("normal"), axis=-1)
        assert (np.isclose(length, 1, atol=2e-3) | (length == 0)).all()


def test_the_photo_and_the_prompt_both_matter(checkpoint: Path) -> None:
    model = RgbXModel.load(checkpoint, "cpu", "float32")
    rng = generator(1, "priors")
    photo = rng.uniform(0, 1, (32, 40, 3)).astype(np.float32)
    base = model(photo, "Roughness", 2, 3)
    assert base.shape == (32, 40, 3)
    assert np.abs(model(1 - photo, "Roughness", 2, 3) - base).max() > 1e-3
    assert np.abs(model(photo, "Metallicness", 2, 3) - base).max() > 1e-6


class Oracle:
    """Stands for the network: knows that the clean latent is the photo's, and gives the velocity towards it.

    v = alpha eps - sigma x0, with x_t = alpha x0 + sigma eps (Salimans and Ho 2022).
    """

    def __init__(self, unet, scheduler) -> None:
        self.device, self.dtype, self.alphas = unet.device, unet.dtype, scheduler.alphas_cumprod

    def __call__(self, seen, step, encoder_hidden_states):
        noisy, clean = seen[:, :4], seen[:, 4:]
        alpha, sigma = self.alphas[step] ** 0.5, (1 - self.alphas[step]) ** 0.5
        return SimpleNamespace(sample=alpha * (noisy - alpha * clean) / sigma - sigma * clean)


@pytest.mark.parametrize("steps", [1, 2, 8])
def test_a_perfect_network_gives_what_it_was_shown(checkpoint: Path, steps: int) -> None:
    """Noise, schedule, order of channels and scales are right if a network that knows the answer gets it."""
    import torch

    model = RgbXModel.load(checkpoint, "cpu", "float32")
    photo = generator(2, "priors").uniform(0, 1, (24, 32, 3)).astype(np.float32)
    with torch.inference_mode():
        pixels = torch.from_numpy(2 * photo - 1).movedim(-1, 0)[None]
        expected = (
            model.vae.decode(model.vae.encode(pixels).latent_dist.mode()).sample[0].movedim(0, -1).numpy()
        )
    oracle = replace(model, unet=Oracle(model.unet, model.scheduler))
    np.testing.assert_allclose(oracle(photo, "Roughness", steps, 5), expected, atol=1e-4)


def test_a_view_s_noise_does_not_depend_on_the_others(checkpoint: Path, ring) -> None:
    photos = capture(ring)
    alone = Capture((photos.views[1],))
    a = apply_prior(photos, prior(checkpoint), ("roughness",)).views[1].read("roughness")
    b = apply_prior(alone, prior(checkpoint), ("roughness",)).views[0].read("roughness")
    np.testing.assert_array_equal(a, b)


def test_linear_photos_are_exposed_before_the_model_sees_them(ring) -> None:
    camera = ring(1, 16, 16)[0]
    bright = View("v", camera, np.full((16, 16, 3), 50.0), "linear")
    np.testing.assert_allclose(linear_photo(bright), 0.18, rtol=1e-4)
    shown = View("v", camera, np.full((16, 16, 3), 0.5), "display")
    np.testing.assert_allclose(linear_photo(shown), 0.5**2.2, rtol=1e-5)


def test_without_a_checkpoint_one_line_says_what_to_give(tmp_path: Path) -> None:
    for missing, message in ((None, "has no checkpoint"), (str(tmp_path / "x"), "not found")):
        with pytest.raises(TronError, match=message) as caught:
            RgbX(missing)  # at once: photos may take minutes to load
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder", "tokenizer", "scheduler"])
def test_a_missing_part_is_named(checkpoint: Path, tmp_path: Path, part: str, plain) -> None:
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    shutil.rmtree(copy / part)
    with pytest.raises(TronError, match=f"lacks {part}/"):
        apply_prior(plain(), prior(copy))


def test_pickled_and_damaged_weights_are_not_read(checkpoint: Path, tmp_path: Path, plain) -> None:
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    weights = next((copy / "unet").glob("*.safetensors"))
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(TronError, match="cannot read unet") as caught:
        apply_prior(plain(), prior(copy))
    assert "\n" not in str(caught.value)
    weights.rename(weights.with_suffix(".bin"))
    with pytest.raises(TronError, match="no safetensors in unet"):
        apply_prior(plain(), prior(copy))


def test_a_scheduler_of_another_kind_is_refused(checkpoint: Path, tmp_path: Path, plain) -> None:
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    path = copy / "scheduler" / "scheduler_config.json"
    path.write_text(path.read_text().replace("v_prediction", "epsilon"))
    with pytest.raises(TronError, match="scheduler predicts epsilon"):
        apply_prior(plain(), prior(copy))


@pytest.mark.parametrize("change", [{"steps": 0}, {"steps": 7}, {"dtype": "float8"}, {"longest_side": 4}])
def test_wrong_options_are_refused(change: dict) -> None:
    with pytest.raises((ValidationError, TronError), match=next(iter(change))):
        RgbX(**change)

"""Codecs: exact inverse, causality, and the library's own arithmetic as witness."""

import numpy as np
import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from scipy.fft import dctn

from tron.errors import TronError
from tron.neural.codecs.block_dct import BlockDCT
from tron.neural.codecs.wan import WanCodec


def video(frames: int, height: int = 16, width: int = 24, batch: int = 2, seed: int = 0) -> torch.Tensor:
    return torch.rand(batch, 3, frames, height, width, generator=torch.Generator().manual_seed(seed)) * 2 - 1


@pytest.fixture(scope="module")
def codec() -> BlockDCT:
    codec = BlockDCT()
    codec.calibrate([video(5, seed=1), video(9, seed=2)])
    return codec


@pytest.mark.parametrize("frames", [1, 5, 9])
def test_decoding_inverts_encoding(codec, frames):
    x = video(frames)
    z = codec.encode(x)
    assert z.shape == (2, 192, 1 + (frames - 1) // 4, 4, 6)
    torch.testing.assert_close(codec.decode(z), x, atol=2e-6, rtol=0)


def test_every_later_latent_is_used_and_inverted_too(codec):
    z = torch.randn(1, 192, 2, 3, 3)
    again = codec.encode(codec.decode(z))
    torch.testing.assert_close(again[:, :, 1:], z[:, :, 1:], atol=1e-4, rtol=1e-4)


def test_latents_are_scipys_dct_of_the_blocks():
    x = video(5, 8, 8, batch=1).double()
    z = BlockDCT().double().encode(x)[0, :, 1].numpy()
    block = x[0, 2, 1:5, 4:8, 0:4].numpy()  # blue, block row 1, block column 0
    np.testing.assert_allclose(
        z[128:192, 1, 0].reshape(4, 4, 4), np.asarray(dctn(block, norm="ortho")), atol=1e-6
    )


def test_one_frame_uses_no_temporal_frequency():
    z = BlockDCT().encode(video(1))
    by_time = z.unflatten(1, (3, 4, 16))
    assert by_time[:, :, 1:].abs().max() < 1e-6
    assert by_time[:, :, 0].abs().max() > 0.1


def test_fitted_latents_have_zero_mean_and_unit_deviation(codec):
    z = torch.cat([codec.encode(video(5, seed=1)).movedim(1, -1).reshape(-1, 192),
                   codec.encode(video(9, seed=2)).movedim(1, -1).reshape(-1, 192)])  # fmt: skip
    torch.testing.assert_close(z.mean(0), torch.zeros(192), atol=1e-4, rtol=0)
    torch.testing.assert_close(z.std(0, correction=0), torch.ones(192), atol=1e-3, rtol=0)


def test_no_latent_sees_later_frames(codec):
    x = video(9)
    later = x.clone()
    later[:, :, 5:] = 0
    torch.testing.assert_close(codec.encode(x)[:, :, :2], codec.encode(later)[:, :, :2], atol=0, rtol=0)
    torch.testing.assert_close(codec.encode(x[:, :, :5]), codec.encode(x)[:, :, :2], atol=1e-6, rtol=0)


def test_the_normalisation_travels_with_the_state(codec):
    other = BlockDCT()
    other.load_state_dict(codec.state_dict())
    torch.testing.assert_close(other.encode(video(5)), codec.encode(video(5)), atol=0, rtol=0)


@pytest.mark.parametrize("shape", [(2, 16, 16), (4, 16, 16), (6, 16, 16), (5, 15, 16), (5, 16, 18)])
def test_shapes_that_would_lose_frames_or_pixels_are_refused(codec, shape):
    with pytest.raises(TronError):
        codec.encode(video(*shape))


def test_nothing_to_fit_on_is_an_error():
    with pytest.raises(TronError, match="fit"):
        BlockDCT().calibrate([])


@pytest.fixture(scope="module")
def vae() -> AutoencoderKLWan:
    torch.manual_seed(0)
    return AutoencoderKLWan(base_dim=8, num_res_blocks=1).eval()


def test_wan_gradients_survive_checkpointing_and_saturation(vae):
    z = WanCodec(vae).encode(video(5, 32, 32, batch=1)) * 30
    gradients = []
    for checkpointed in (False, True):
        leaf = z.clone().requires_grad_()
        shown = WanCodec(vae, checkpointed).decode(leaf)
        assert shown.abs().max() > 1  # where diffusers' clamp would leave no gradient
        shown.square().mean().backward()
        gradients.append(leaf.grad)
    assert gradients[0].abs().max() > 0
    torch.testing.assert_close(gradients[1], gradients[0], atol=1e-7, rtol=1e-4)


def test_wan_refuses_sizes_it_would_truncate(vae):
    with pytest.raises(TronError):
        WanCodec(vae).encode(video(1, 24, 32))
    with pytest.raises(TronError):
        WanCodec(vae).encode(video(3, 32, 32))

"""The WAN codec is diffusers' own arithmetic, bit by bit, in memory that hardly grows with the frames."""

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

from tron.neural.codecs.wan import WanCodec


def video(frames: int, size: int = 32) -> torch.Tensor:
    return torch.rand(1, 3, frames, size, size, generator=torch.Generator().manual_seed(0)) * 2 - 1


@pytest.fixture(scope="module")
def vae() -> AutoencoderKLWan:
    torch.manual_seed(0)
    return AutoencoderKLWan(base_dim=8, num_res_blocks=1).eval()


@pytest.mark.parametrize("frames", [1, 5, 9])
def test_chunks_are_diffusers_own_encode_and_decode_bit_by_bit(vae, frames):
    x, codec = video(frames), WanCodec(vae)
    mean, std = (
        torch.tensor(v).view(1, -1, 1, 1, 1) for v in (vae.config.latents_mean, vae.config.latents_std)
    )
    with torch.no_grad():
        z = codec.encode(x)
        torch.testing.assert_close(z, (vae.encode(x).latent_dist.mode() - mean) / std, atol=0, rtol=0)
        expected = vae.decode(z * std + mean).sample
        torch.testing.assert_close(codec.decode(z).clamp(-1, 1), expected, atol=0, rtol=0)
    assert z.shape[2] == 1 + (frames - 1) // 4


def test_two_clips_in_turn_do_not_see_each_other(vae):
    codec = WanCodec(vae)
    with torch.no_grad():
        alone = codec.decode(codec.encode(video(5)))
        codec.decode(codec.encode(video(9) * -1))
        torch.testing.assert_close(codec.decode(codec.encode(video(5))), alone, atol=0, rtol=0)


@pytest.mark.parametrize("frames", [1, 5, 9])
def test_gradients_of_decoding_are_the_same_with_checkpoints(vae, frames):
    z = WanCodec(vae).encode(video(frames)) * 10
    gradients = []
    for checkpointed in (False, True):
        leaf = z.clone().requires_grad_()
        WanCodec(vae, checkpointed).decode(leaf).square().mean().backward()
        gradients.append(leaf.grad)
    assert gradients[0].abs().max() > 0
    torch.testing.assert_close(gradients[1], gradients[0], atol=0, rtol=0)


def test_encoding_takes_no_gradient_and_hardly_more_memory_for_more_frames(vae, live_memory):
    codec, peaks = WanCodec(vae), []
    for frames in (9, 33):  # the caches are full after nine
        x = video(frames).requires_grad_()
        with live_memory() as memory:
            z = codec.encode(x)
        assert not z.requires_grad
        peaks.append(memory.peak)
    print([f"{peak / 2**20:.2f} MiB" for peak in peaks])
    # What does grow are the moments, kept until all are there: 32 numbers for 8 x 8 x 4 pixels.
    assert peaks[1] - peaks[0] < 0.05 * peaks[0]


def test_checkpoints_bound_the_memory_of_the_backward_pass(vae, live_memory):
    peaks = {}
    for checkpointed in (False, True):
        for frames in (9, 33):
            leaf = WanCodec(vae).encode(video(frames)).requires_grad_()
            with live_memory() as memory:
                WanCodec(vae, checkpointed).decode(leaf).square().mean().backward()
            peaks[checkpointed, frames] = memory.peak
    print({key: f"{peak / 2**20:.1f} MiB" for key, peak in peaks.items()})
    assert peaks[True, 33] < peaks[False, 33] / 2
    # Of a further chunk only its features' cache is kept, not all that is between them.
    assert peaks[True, 33] - peaks[True, 9] < 0.3 * (peaks[False, 33] - peaks[False, 9])

"""Sharpness, what becomes of a perfect input, materials and FLIP: closed forms."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.relighting.buffers import Buffers, region_mask
from eval.relighting.networks import Network
from eval.relighting.scores import METRICS, Score, Scores
from eval.renderer.gains import material_rows, seen_rows
from eval.renderer.identity import Identity, least_identity
from eval.renderer.sharpness import Gradients, gradient_product, sharpness_rows
from eval.renderer.truths import Truths
from eval.results import Row
from tron.color import from_agx
from tron.seeds import generator
from tron.shards.schema import TARGET, Clip

MakeClip = Callable[..., Clip]
RIVALS = ["lit", "lit_filtered", "lit_oidn"]


def values(rows) -> dict[str, Row]:
    return {row.metric: row for row in rows}


def waves(size: int, period: int) -> np.ndarray:
    """(size, size, 3) of 0.5 + 0.2 sin along the columns' axis."""
    wave = 0.5 + 0.2 * np.sin(2 * np.pi * np.arange(size) / period)
    return np.broadcast_to(wave[None, :, None], (size, size, 3))


def test_the_squared_gradient_of_a_wave_is_that_of_its_formula():
    """Neighbours of a sin(w x) differ by 2 a sin(w / 2) cos(w (x + 1/2)): 2 a^2 sin^2(w / 2) in the mean."""
    image, everywhere = waves(65, 16), np.ones((65, 65), bool)
    found = gradient_product(image, image, everywhere)
    assert found == pytest.approx(2 * 0.2**2 * np.sin(np.pi / 16) ** 2, rel=1e-6)
    assert gradient_product(image.swapaxes(0, 1), image, everywhere) == pytest.approx(0, abs=1e-12)


def test_pairs_count_that_lie_inside_both():
    image, inside = np.zeros((6, 8, 3)), np.zeros((6, 8), bool)
    inside[:, 2:5] = True
    image[:, 5:] = 9.0  # a step outside, and one at the rim
    image[:, :2] = -9.0
    image[:, 4] = 1.0
    assert gradient_product(image, image, inside) == pytest.approx(0.5), "one of two pairs in a row"
    assert gradient_product(image, image, np.zeros_like(inside)) == 0


def shown(clip: Clip, display: np.ndarray) -> np.ndarray:
    """Linear radiance that is displayed as it, of all frames."""
    frames = np.broadcast_to(display, clip.frames[TARGET].shape)
    return (from_agx(frames.astype(np.float32)) / clip.meta.exposure).astype(np.float32)


def test_the_noise_of_the_truth_plays_no_part(drawn_clip: MakeClip):
    """Two renders whose noise has four times the squared gradient of the wave: the wave's own is found."""
    clip = drawn_clip(frames=2, size=96)
    clip.frames["foreground"] = np.ones_like(clip.frames["foreground"])
    wave, rng = waves(96, 12), generator(0, "tests", "sharpness")
    noise = 0.08 * rng.standard_normal((2, *clip.frames[TARGET].shape))
    renders = [shown(clip, np.clip(wave + each, 0.02, 0.98)) for each in noise]
    blurred = 0.5 + 0.5 * (wave - 0.5)  # half the contrast, a quarter of the square
    scores = Scores(more=Gradients(Truths({clip.meta.key: renders})))
    images = {"neural_lit": wave, "lit": blurred, "lit_filtered": wave, "lit_oidn": 0.8 * wave}
    frames = {name: np.broadcast_to(each, clip.frames[TARGET].shape) for name, each in images.items()}
    truth = np.broadcast_to(wave, clip.frames[TARGET].shape)
    scores.add(clip, {"foreground": frames, "frame": frames}, truth)
    rows = values(sharpness_rows("ood_", scores, RIVALS, ".96", 0))
    start = "renderer.ood_sharpness"
    assert rows[f"{start}.neural_lit.96"].value == pytest.approx(1, abs=0.05)
    assert rows[f"{start}.lit.96"].value == pytest.approx(0.25, abs=0.02)
    assert rows[f"{start}.best_rival.96"].value == rows[f"{start}.neural_lit.96"].value, "it is the wave too"
    assert rows["renderer.lit.ood_sharpness_over_oidn.96"].value == pytest.approx(1 / 0.8**2)
    noisy = gradient_product(noise[0, 0], noise[0, 0], np.ones((96, 96), bool))
    assert noisy > 4 * gradient_product(wave, wave, np.ones((96, 96), bool))
    alone = Scores(more=Gradients(Truths({clip.meta.key: renders[:1]})))
    alone.add(clip, {"foreground": frames, "frame": frames}, truth)
    assert not list(sharpness_rows("ood_", alone, RIVALS, ".96", 0)), "one render does not tell its noise"


def test_a_network_is_judged_by_what_it_makes_of_the_truth(
    drawn_clip: MakeClip, monkeypatch: pytest.MonkeyPatch
):
    """One that adds 0.01 to lit, and 1 to what it is given besides where that is touched."""
    clip = drawn_clip()
    others = {name: clip.frames[name] for name in ("pbr", "albedo")}

    def show(self: Network, buffers: Buffers) -> np.ndarray:
        assert buffers["lit"] is clip.frames[TARGET]
        assert all(buffers[name] is each for name, each in others.items())
        return buffers.displayed("lit") + 0.01

    monkeypatch.setattr(Network, "show", show)
    identity = Identity(Network(Path("none"), None), lambda clip: clip.frames[TARGET])  # type: ignore[arg-type]
    assert identity.rows("renderer.ood_", ".32", 0) == []
    identity.add(clip)
    (row,) = identity.rows("renderer.ood_", ".32", 0)
    assert (row.metric, row.value, row.n) == ("renderer.ood_identity_psnr.32", pytest.approx(40, abs=1e-3), 2)
    worse = row.model_copy(update={"metric": "renderer.few_final_identity_psnr.512", "value": 31.0})
    other = row.model_copy(update={"metric": "renderer.ood_psnr.lit.128", "value": 20.0})
    noisy = row.model_copy(update={"metric": "renderer.validation.final_identity_psnr.512", "value": 1.0})
    (least,) = least_identity([row, worse, other, noisy])
    assert (least.metric, least.value) == ("renderer.identity_psnr", 31.0)


def test_metals_do_not_carry_the_gain_of_the_rest(drawn_clip: MakeClip):
    """lit is 0.1 off on metal, 0.01 elsewhere; the network 0.01 everywhere: all of its gain is metal's."""
    clip = drawn_clip(frames=1)
    surface = clip.frames["surface"]
    surface[..., 2] = 0
    surface[:, 14:20, 8:24, 2] = 1
    metal = region_mask(clip, "metal")
    assert metal.sum() + region_mask(clip, "rest").sum() == region_mask(clip, "foreground").sum()
    assert 64 <= metal.sum() < region_mask(clip, "rest").sum()
    truth = np.full_like(clip.displayed(TARGET), 0.5)
    lit = truth + np.where(metal, 0.1, 0.01)[..., None]
    scores = Scores(materials=True)
    images = {"lit": lit, "neural_lit": truth + 0.01}
    scores.add(clip, {"foreground": images, "frame": images}, truth)
    rows = values(material_rows("ood_", scores, ".32", 0))
    assert rows["renderer.lit.ood_gain_over_lit_db_metal.32"].value == pytest.approx(20, abs=1e-3)
    assert rows["renderer.lit.ood_gain_over_lit_db_rest.32"].value == pytest.approx(0, abs=1e-4)
    assert rows["renderer.ood_psnr.lit_metal.32"].value == pytest.approx(20, abs=1e-3)
    surface[..., 2] = 0
    plain = Scores(materials=True)
    plain.add(clip, {"foreground": images, "frame": images}, truth)
    assert not any("_metal" in name for name in values(material_rows("", plain, "", 0))), "there is none"


@pytest.mark.skipif(len(METRICS) < 3, reason="pip install 'tron-relight[flip]'")
def test_less_flip_is_better_and_a_gain_is_towards_less():
    scores = Scores()
    for method, flip in (("lit", 0.10), ("lit_filtered", 0.08), ("neural_lit", 0.05)):
        figures = {"psnr": 30.0, "ssim": 0.9, "flip": flip}
        scores.kept[method, "foreground"] += [Score("sun", s, f"{s}0", figures) for s in ("a", "b")]
    rows = values(seen_rows("", scores, "", 0))
    assert rows["renderer.flip.lit"].value == pytest.approx(0.10)
    gain = rows["renderer.lit.flip_gain"]
    assert (gain.value, gain.low) == (pytest.approx(0.03), pytest.approx(0.03))


@pytest.mark.skipif(len(METRICS) < 3, reason="pip install 'tron-relight[flip]'")
def test_flip_is_nothing_between_equals_and_one_between_black_and_white():
    """Of even pictures FLIP is its colour difference alone: 1 for the farthest colours that there are."""
    flip = next(metric for metric in METRICS if metric.name == "flip")
    even, half = np.full((24, 24, 3), 0.5, np.float32), np.zeros((24, 24), bool)
    assert flip.measure(even, even, None) == 0
    half[:12] = True
    green, blue = (np.broadcast_to(np.array(each, np.float32), even.shape) for each in ((0, 1, 0), (0, 0, 1)))
    assert flip.measure(green, blue, half) == pytest.approx(1, abs=0.02)

"""Laws of materials from photos: what made the photos is found again, in a light that is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tron.captures import Capture, View
from tron.estimation import Estimation
from tron.gaussians import GaussianScene
from tron.reconstruction.evidence import gather_evidence
from tron.reconstruction.explanation import photographed_bounces, receive
from tron.reconstruction.inverse_rendering import InverseRenderer, RefinementSettings
from tron.reconstruction.lobes import ROUGHNESSES, Materials, choose, materials_of
from tron.reconstruction.observations import observe
from tron.reconstruction.photographed_sky import photographed_sky
from tron.seeds import generator
from tron.shading.bounce import BounceTransport
from tron.shading.cubemap import direction_face
from tron.shading.environment import EnvironmentLight, EnvironmentMap
from tron.shading.guidance import render_guidance
from tron.shading.lighting import Lighting
from tron.tracing import SurfelTracer


@pytest.fixture(scope="module")
def lighting(variant: str) -> Lighting:
    """A dim room with two lamps, one of them small."""
    image = np.full((32, 64, 3), 0.2, np.float32)
    image[6:9, 10:13] = (20, 18, 15)
    image[10:16, 36:46] = (2.0, 2.5, 3.0)
    return Lighting(EnvironmentMap(image), 64)


@pytest.fixture(scope="module")
def scene(dense_surfels) -> GaussianScene:
    """A glossy ball, metal on its left half, above a rough floor in patches."""
    dense = dense_surfels
    made = dense.scene(dense.plane(0.12, 1.2), dense.sphere(0.12, 0.6, 0.65), spacing=0.12)
    ball = made.means[:, 2] > 0.01
    patch = np.floor(made.means[:, :2] * 2).astype(int).sum(1) % 2 == 0
    made.base_color = np.where(patch[:, None], (0.7, 0.5, 0.3), (0.2, 0.3, 0.5)).astype(np.float32)
    made.base_color[ball] = (0.6, 0.4, 0.3)
    made.roughness = np.where(ball, 0.25, 0.95).astype(np.float32)
    made.metallic = (ball & (made.means[:, 0] < 0)).astype(np.float32)
    return made


@pytest.fixture(scope="module")
def capture(scene: GaussianScene, lighting: Lighting, around) -> Capture:
    """Linear pictures of ``lit``, the environment behind them."""
    tracer, views = SurfelTracer(scene), []
    bounce = BounceTransport.trace(tracer).bake(lighting)
    for i, camera in enumerate(around(24, size=40)):
        if camera.position[2] < 0:
            continue
        found = render_guidance(tracer, camera, lighting, Estimation(rays=32), i, bounce=bounce)
        views.append(View(f"{i:02d}", camera, found.lit, "linear"))
    return Capture(tuple(views))


@pytest.fixture(scope="module")
def chosen(scene: GaussianScene, capture: Capture, lighting: Lighting) -> Any:
    """Materials by evidence, and the evidence."""
    blank = replace(scene, base_color=np.full((len(scene), 3), 0.5))
    tracer = SurfelTracer(blank)
    found = observe(tracer, capture.train_views, 1.0, "srgb")
    evidence = gather_evidence(found, same_exposure=True)
    transport = BounceTransport.trace(tracer)
    received = receive(transport, lighting, photographed_bounces(transport, evidence.color), 0)
    return materials_of(blank, found, evidence, lighting, received, 0.6), evidence


def psnr(found: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(((found - truth) ** 2).mean()))


def test_highlights_that_move_tell_gloss_and_metal(scene: GaussianScene, chosen: Any) -> None:
    materials, evidence = chosen
    assert isinstance(materials, Materials)
    seen = evidence.count >= 3
    ball, metal = scene.means[:, 2] > 0.01, scene.metallic > 0.5
    assert materials.roughness[seen & ball].mean() < 0.45
    assert materials.roughness[seen & ~ball].mean() > materials.roughness[seen & ball].mean() + 0.2
    assert materials.metallic[seen & metal].mean() > 0.7
    assert materials.metallic[seen & ~metal].mean() < 0.2
    assert materials.confidence[seen].mean() > 0.4


def test_where_all_materials_explain_alike_the_prior_decides(scene: GaussianScene, chosen: Any) -> None:
    _, evidence = chosen
    kinds = 2 * len(ROUGHNESSES)
    bases = np.full((kinds, len(scene), 3), 0.5)
    none = choose(scene, evidence, bases, np.zeros((kinds, len(scene))), 0.35)
    assert none.confidence.max() < 1e-6
    assert none.metallic.max() < 0.35
    told = np.zeros((kinds, len(scene)))
    told[1:] = evidence.count  # the first, of the sharpest lobe, explains every photo
    sharp = choose(scene, evidence, bases, told, 0.35)
    seen = evidence.seen
    np.testing.assert_allclose(sharp.roughness[seen], ROUGHNESSES[0], atol=0.01)
    assert sharp.confidence[seen].min() > 0.5


def test_base_color_is_free_of_shadows_and_highlights(scene: GaussianScene, chosen: Any) -> None:
    materials, evidence = chosen
    seen = evidence.count >= 3
    naive = evidence.color * (scene.base_color[seen].mean() / evidence.color[seen].mean())
    # Pixels are as wide as surfels here: where two patches meet, their colours are mixed.
    found = psnr(materials.base_color[seen], scene.base_color[seen])
    assert found > 20
    assert found > psnr(naive[seen], scene.base_color[seen]) + 3


def test_photos_bring_wrong_materials_to_the_true_ones(
    scene: GaussianScene, capture: Capture, lighting: Lighting
) -> None:
    draw = generator(0, "tests", "wrong")
    wrong = np.clip(scene.base_color * np.exp(draw.normal(0, 0.3, (len(scene), 1))), 0, 1)
    begin = replace(scene, base_color=wrong, roughness=np.full(len(scene), 0.5))
    gains = np.ones((len(capture.views), 3))
    settings = RefinementSettings(steps=50, rays=8, tie=0.01)
    renderer = InverseRenderer(begin, capture.views, gains, lighting, 1.0, "srgb", settings, 0)
    found = renderer.refine()
    losses = np.array(renderer.losses)
    assert losses[-10:].mean() < 0.65 * losses[:5].mean()
    up = scene.normals()[:, 2] > -0.3
    assert psnr(found.base_color[up], scene.base_color[up]) > psnr(wrong[up], scene.base_color[up]) + 3
    held = RefinementSettings(steps=5, rays=8, tie=1e6)
    kept = InverseRenderer(begin, capture.views, gains, lighting, 1.0, "srgb", held, 0).refine()
    moved = np.abs(found.roughness - 0.5).mean()
    assert np.abs(kept.roughness - 0.5).mean() < 0.3 * moved


def test_the_sky_behind_the_scene_is_the_environment(
    scene: GaussianScene, capture: Capture, lighting: Lighting
) -> None:
    gains = np.ones((len(capture.views), 3))
    sky = photographed_sky(SurfelTracer(scene), capture.views, gains, 1.0, "srgb", 8, 0)
    known = sky.trust > 0.8
    assert 0.1 < known.mean() < 0.9
    centres = _texel_centres(8)
    assert isinstance(lighting.light, EnvironmentLight)
    shown = lighting.light.environment.lookup(centres)
    off = np.abs(np.log(sky.radiance[known] / shown[known]))
    assert np.median(off) < 0.1
    masked = [replace(view, mask=np.ones((40, 40))) for view in capture.views]
    none = photographed_sky(SurfelTracer(scene), masked, gains, 1.0, "srgb", 8, 0)
    assert not none.trust.any()
    seen = [SurfelTracer(scene).gbuffer(view.camera).numpy()["opacity"] < 0.05 for view in capture.views]
    told = [replace(view, sky_mask=each) for view, each in zip(masked, seen)]
    of_masks = photographed_sky(SurfelTracer(scene), told, gains, 1.0, "srgb", 8, 0)
    np.testing.assert_array_equal(of_masks.radiance, sky.radiance)


def _texel_centres(resolution: int) -> np.ndarray:
    from tron.reconstruction.sky_visibility import cube_texels

    centres = cube_texels(resolution)[0]
    import mitsuba as mi

    face = np.array(direction_face(mi.Vector3f(*[mi.Float(c.astype(np.float32)) for c in centres.T]))[0])
    assert (np.bincount(face) == resolution**2).all()
    return centres

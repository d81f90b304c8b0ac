"""Laws of the rays of a lobe: their mean Fresnel is the table's albedo, their density that of their draws."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from examples.stage import BALL, make_scene
from tron.brdf.reflectance import Layers, fresnel, reflectance
from tron.brdf.table import BrdfTable
from tron.estimation import Estimation
from tron.relighting import Relighter
from tron.seeds import generator
from tron.shading import reflections as reflection_rays
from tron.shading.reflections import Lobe

N = 1 << 18


def lobe_of(cosine: float, roughness: float) -> Lobe:
    view = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    scale, bias, _, _ = BrdfTable.load()(mi.Float(roughness), mi.Float(cosine))
    return Lobe(mi.Frame3f(mi.Normal3f(0, 0, 1)), view, mi.Float(roughness**2), scale + bias)


def uniform() -> mi.Point2f:
    return mi.Point2f(generator(3, "tests", "lobe").random((2, N)).astype(np.float32))


@pytest.mark.parametrize(
    ("brdf", "metallic"), [("conserving", 0.0), ("lambert", 0.0), ("lambert", 0.6), ("conserving", 1.0)]
)
@pytest.mark.parametrize(("cosine", "roughness"), [(0.2, 0.5), (0.7, 0.15), (0.9, 0.9)])
def test_the_mean_fresnel_of_rays_is_the_albedo_of_the_lobe(
    variant: str, material, cosine: float, roughness: float, metallic: float, brdf: str
) -> None:
    surface, lobe = material(0.6, roughness, metallic), lobe_of(cosine, roughness)
    out, above = lobe.draw(uniform())
    half = dr.normalize(out + lobe.view)
    layers = Layers.of(surface, BrdfTable.load(), mi.Float(cosine)) if brdf == "conserving" else None
    weight = fresnel(surface, dr.dot(half, lobe.view), brdf, layers) * lobe.albedo
    mean = np.array(dr.select(above, weight, 0)).mean(1)
    share = reflectance(surface, BrdfTable.load(), mi.Float(cosine), brdf)
    np.testing.assert_allclose(mean, np.array(share.specular)[:, 0], atol=4e-3)


@pytest.mark.parametrize(("cosine", "roughness"), [(0.2, 0.5), (0.7, 0.3), (0.9, 0.9), (0.4, 1.0)])
def test_rays_are_drawn_by_their_density(variant: str, cosine: float, roughness: float) -> None:
    """Share of the draws in parts of the hemisphere, and the integral of the density over them."""
    lobe = lobe_of(cosine, roughness)
    out, above = lobe.draw(uniform())
    everywhere = mi.warp.square_to_uniform_hemisphere(uniform())
    density = lobe.density(everywhere) * float(2 * np.pi)
    for part in (
        lambda d: d.z > 0,
        lambda d: (d.z > 0) & (d.x < 0),
        lambda d: d.z > 0.8,
        lambda d: (d.z > 0) & (d.y > 0.3),
    ):
        drawn = np.array(above & part(out)).mean()
        integral = np.array(dr.select(part(everywhere), density, 0), np.float64).mean()
        assert drawn == pytest.approx(integral, abs=0.015)


def test_a_rough_floor_has_few_white_specks_beside_a_polished_ball(variant, sun_map, camera, monkeypatch):
    """Its lobe is noisier where mirrors in it are as sharp as they are; in the mean it is as bright."""
    scene = make_scene(0.1)
    ball = scene.object_id == BALL
    scene.metallic[:], scene.roughness[:] = ball, np.where(ball, 0.05, 0.5)
    found = {}
    for share in (0.0, reflection_rays.ROUGHER):
        monkeypatch.setattr(reflection_rays, "ROUGHER", share)
        under = Relighter(scene, Estimation(reflections=4), proxy="never").under(sun_map)
        frames = np.stack([under.render(camera, seed).lit for seed in range(8)])
        rough = np.abs(under.render(camera, 0).gbuffer["roughness"] - 0.5) < 0.01
        found[share] = frames[:, rough].mean(), frames[:, rough].std(0).max()
    (mean, noise), (other, less) = found.values()
    assert other == pytest.approx(mean, rel=0.01)
    assert less < 0.7 * noise

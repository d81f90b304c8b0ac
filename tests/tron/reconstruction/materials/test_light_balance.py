"""The law of a balanced camera where light bounces, against Mitsuba's path tracer: an open box.

The joint fit tells light up to a factor. Whatever that factor was, what the camera's meter says leads back to
the light, the paint and the gloss that made the photos.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import pytest

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.captures import Capture, View
from tron.color import linear_to_srgb, luminance
from tron.gaussians import GaussianScene
from tron.reconstruction import Joint
from tron.reconstruction.light.fit_pairs import Light, LightSettings
from tron.reconstruction.light.sky_visibility import cube_texels
from tron.reconstruction.light.surfel_colors import SurfelColors, observe
from tron.reconstruction.materials.brdf_search import Received
from tron.reconstruction.materials.carried import described
from tron.reconstruction.materials.joint_fit import JointFit, LightFinder, fit_jointly, light_balance
from tron.runtime import lanes
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

SPACING, TEXELS = 0.1, 16
BOUNCES, PATHS, VIEWS, SIDE = 12, 64, 20, 48
WALLS = (0.56, 0.49, 0.42), (0.6, 0.21, 0.18), (0.25, 0.56, 0.28), (0.7, 0.7, 0.7), (0.7, 0.7, 0.7)
PLASTIC, GLOSS = (0.1, 0.15, 0.4), 0.25


@dataclass(frozen=True)
class Box:
    """A box of five coloured walls around a ball of plastic, by a camera that balances and meters."""

    scene: GaussianScene
    capture: Capture
    light: EnvironmentMap

    @property
    def ball(self) -> np.ndarray:
        """(M,) bool: surfels of the ball."""
        return self.scene.object_id == 1

    def fitted(self, patch: pytest.MonkeyPatch, factor: float) -> JointFit:
        """The joint fit where the light that is found is the true one times a factor."""
        texels = self.light.lookup(cube_texels(TEXELS)[0]).astype(np.float32)
        found = Light(np.float32(factor) * texels, np.zeros(3, np.float32), 0.0), None
        patch.setattr(LightFinder, "find", lambda *_: found)
        count = len(self.scene)
        blank = replace(self.scene, base_color=np.full((count, 3), 0.5), roughness=np.full(count, 0.5))
        return fit_jointly(self.capture, blank, Joint(light=LightSettings(points=200)), 0)


@pytest.fixture(scope="module")
def box(variant: str, dense_surfels) -> Box:
    dense = dense_surfels
    floor, turned = dense.plane(SPACING, 1.0), []
    for inwards in ((-1.0, 0, 0), (1.0, 0, 0), (0, -1.0, 0), (0, 1.0, 0)):
        side = np.cross((0, 0, 1.0), inwards)
        wall = dense.turned(floor, np.stack([side, (0, 0, 1.0), inwards], 1))
        place = np.array([0, 0, 1.0]) - inwards
        moved = mi.ScalarTransform4f().translate(place.tolist()) @ wall.mitsuba["to_world"]
        turned.append(replace(wall, points=wall.points + place, mitsuba={**wall.mitsuba, "to_world": moved}))
    sheets = [floor, *turned, dense.sphere(SPACING, 0.45, 0.5)]
    counts = [len(sheet.points) for sheet in sheets]
    scene = dense.scene(
        *sheets,
        spacing=SPACING,
        base_color=np.repeat([*WALLS, PLASTIC], counts, axis=0).astype(np.float32),
        roughness=np.repeat([*np.full(5, 0.95), GLOSS], counts),
        object_id=np.repeat([0, 0, 0, 0, 0, 1], counts),
    )
    image = np.full((32, 64, 3), 0.3, np.float32)
    image[4:8, 10:16] = 12.0
    image *= np.array([1.0, 0.8, 0.5], np.float32)
    paints = [*zip(WALLS, np.full(5, 0.95)), (PLASTIC, GLOSS)]
    world = {
        f"shape{k}": {
            **sheet.mitsuba,
            "bsdf": metallic_roughness({"type": "rgb", "value": list(color)}, float(roughness), 0.0),
        }
        for k, (sheet, (color, roughness)) in enumerate(zip(sheets, paints))
    }
    built = mi.load_dict({"type": "scene", "light": EnvironmentMap(image).to_mitsuba(), **world})
    cameras = []
    for k in range(VIEWS):
        height, out = ((1.0, 0.8), (1.9, 0.75), (2.6, 0.5))[k % 3]
        turn = np.array([np.cos(2 * np.pi * k / VIEWS), np.sin(2 * np.pi * k / VIEWS), 0])
        eye, at = out * turn + (0, 0, height), (0, 0, 0.5) - 0.5 * turn
        cameras.append(Camera.look_at(eye, at, fov_deg=80, width=SIDE, height=SIDE))
    integrator = mi.load_dict({"type": "path", "max_depth": BOUNCES, "hide_emitters": True})
    views = []
    for k, camera in enumerate(cameras):
        sensor = mi.load_dict(mitsuba_sensor(camera, spp=PATHS, pixel_format="rgba"))
        frame = np.array(mi.render(built, sensor=sensor, integrator=integrator, seed=mi.UInt32(k), spp=PATHS))
        views.append(
            View(
                f"{k:02d}", camera, np.maximum(frame[..., :3], 0), "linear", mask=np.clip(frame[..., 3], 0, 1)
            )
        )
    gains = meter(scene, built, views)
    taken = [
        replace(view, image=linear_to_srgb(np.clip(view.read() * gains, 0, 1)), space="display")
        for view in views
    ]
    return Box(scene, Capture(tuple(taken), tone_curve="srgb"), EnvironmentMap(image * gains))


def meter(scene: GaussianScene, built: mi.Scene, views: list[View]) -> np.ndarray:
    """(3,) gains of a camera by which what arrives at what it sees is grey, and the whole picture 0.18.

    Three tenths of that are the scene, the rest has albedo 0.25 in the same light.
    """
    seen = np.unique(observe(SurfelTracer(scene), views, 1.0, "srgb").surfel)
    base, normal = scene.base_color[seen], np.repeat(scene.normals()[seen], PATHS, 0)
    draw = generator(0, "tests", "hemispheres")
    towards = normal + _unit(draw.normal(size=normal.shape))  # by the cosine
    start = np.repeat(scene.means[seen], PATHS, 0) + 1e-3 * normal
    ray = mi.RayDifferential3f(lanes(mi.Point3f, start), lanes(mi.Vector3f, _unit(towards)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(start))
    path = mi.load_dict({"type": "path", "max_depth": BOUNCES - 1})
    arrived = np.array(path.sample(built, sampler, ray)[0]).T.reshape(len(seen), PATHS, 3).mean(1)
    white = luminance(arrived.mean(0)) / arrived.mean(0)
    returned = luminance((base * arrived).mean(0) * white)
    exposure = 0.18 / (0.7 * 0.25 * luminance(arrived.mean(0)) + 0.3 * returned)
    return (exposure * white).astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def fits(box: Box) -> dict[float, JointFit]:
    with pytest.MonkeyPatch.context() as patch:
        return {factor: box.fitted(patch, factor) for factor in (0.4, 2.5)}


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_light_paint_and_gloss_are_found_whatever_the_light_was_thought_to_be(
    box: Box, fits: dict[float, JointFit], factor: float
) -> None:
    """Base color and light scaled by one factor (64 x 64 pixels): |log| 0.25 on the ball, gloss 0.51."""
    fit = fits[factor]
    light = fit.environment.image.mean((0, 1)) / box.light.image.mean((0, 1))
    np.testing.assert_allclose(light, 1, atol=0.18)
    seen = fit.colors.count >= 3
    off = np.abs(np.log(np.maximum(fit.scene.base_color, 1e-3) / box.scene.base_color)).mean(1)
    assert np.median(off[seen & box.ball]) < 0.14
    assert np.median(off[seen & ~box.ball]) < 0.13
    assert 0.2 < fit.scene.roughness[seen & box.ball].mean() < 0.4


def test_the_brightness_that_the_fit_found_decides_nothing(fits: dict[float, JointFit]) -> None:
    dim, bright = fits.values()
    np.testing.assert_allclose(bright.balance / dim.balance, 2.5 / 0.4, rtol=1e-3)
    np.testing.assert_allclose(bright.environment.image, dim.environment.image, rtol=2e-3, atol=1e-4)
    for name in ("base_color", "roughness", "metallic"):
        np.testing.assert_allclose(getattr(bright.scene, name), getattr(dim.scene, name), atol=0.02)


def test_the_tint_that_is_told_is_that_of_the_light_that_was_found(
    box: Box, fits: dict[float, JointFit]
) -> None:
    """Not that of what bounced, which the balance takes into account."""
    up = np.array([0.0, 0.0, 1.0])
    light = box.light.unoccluded(up)
    numbers = ", ".join(f"{x:.2f}" for x in light / light.mean())
    assert {described(fit, up).split("R, G, B ")[1] for fit in fits.values()} == {f"{numbers})"}


def test_what_nearly_all_bounced_leaves_the_light_a_fifth(caplog: pytest.LogCaptureFixture) -> None:
    """And where none comes straight from the light, it stays as it was found; both are told."""
    colors = SurfelColors(np.full((4, 3), 0.18, np.float32), np.zeros(4), np.ones(4, int), np.ones((1, 3)))
    light = np.full((4, 3), 2.0)
    red = np.array([0.7, 0.1, 0.1])
    with caplog.at_level(logging.WARNING):
        found = light_balance(Received(light, light, np.tile(red, (4, 1)), np.ones(4)), colors)
    np.testing.assert_allclose(2.0 / found, [0.72 / 5, 0.62, 0.62], rtol=1e-3)
    assert "nearly all light that photos show has bounced" in caplog.text
    none = light_balance(Received(0 * light, light, np.tile(red, (4, 1)), np.ones(4)), colors)
    np.testing.assert_array_equal(none, 1)
    assert "no light reaches what photos show but by bounces" in caplog.text

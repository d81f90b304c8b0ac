"""Light in harmonics: closed forms, and pictures that no fit saw."""

from dataclasses import replace

import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import Look, to_display
from tron.errors import TronError
from tron.estimation import PREVIEW, Estimation
from tron.gaussians.harmonics import SH_C0, dc_to_rgb, eval_sh
from tron.gaussians.scene import GaussianScene
from tron.metrics import psnr
from tron.relighting import Relighter
from tron.relighting.baking import baked
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

SPACING = 0.06


@pytest.fixture(scope="module")
def sun() -> EnvironmentMap:
    """A dim sky with a sun some 60 degrees high in the +x direction."""
    image = np.full((64, 128, 3), 0.2, np.float32)
    image[10:13, 30:34] = 120.0
    return EnvironmentMap(image)


@pytest.fixture(scope="module")
def scene(dense_surfels) -> GaussianScene:
    """A rough metal ball on a grey floor."""
    floor, ball = dense_surfels.plane(SPACING, 1.5), dense_surfels.sphere(SPACING, 0.5, 0.5)
    metal = np.repeat([0, 1], [len(floor.points), len(ball.points)])
    return dense_surfels.scene(
        floor, ball, spacing=SPACING, metallic=metal, roughness=0.8 - 0.2 * metal,
        base_color=np.where(metal[:, None] == 1, [0.8, 0.5, 0.3], 0.5),
    )  # fmt: skip


def drawn(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Composited harmonics over black, (H, W, 3)."""
    view = SurfelTracer(scene).gbuffer(camera)
    return view.images({"rgb": view.rgb})["rgb"]


def test_white_under_constant_light_has_its_display_value_from_everywhere(dense_surfels):
    """A white furnace: what leaves is what arrives; nothing but the constant of the harmonics."""
    plane = dense_surfels.plane(0.1, 1.0)
    white = dense_surfels.scene(plane, spacing=0.1, base_color=np.ones((len(plane.points), 3)))
    light = Relighter(white, PREVIEW).under(EnvironmentMap.constant(0.7))
    looks: dict[Look, float] = {"photograph": 0.5, "none": 2.0}
    for look, exposure in looks.items():
        sh = baked(light, exposure, look).sh
        expected = to_display(np.full(3, 0.7 * exposure), 1.0, look=look)
        np.testing.assert_allclose(dc_to_rgb(sh[:, 0]), np.tile(expected, (len(sh), 1)), atol=5e-3)
        assert np.abs(sh[:, 1:]).max() * SH_C0 < 5e-3


def test_a_surfel_in_shadow_is_dark_and_one_in_the_open_as_bright_as_its_irradiance(dense_surfels):
    """A sun at the zenith, a sheet above the middle of a floor: what bounces alone lights what is below."""
    image = np.zeros((64, 128, 3), np.float32)
    image[0] = 1000.0
    zenith = EnvironmentMap(image)
    floor, roof = dense_surfels.plane(SPACING, 1.5), dense_surfels.plane(SPACING, 0.5)
    roof = replace(roof, points=roof.points + np.array([0, 0, 0.8]))
    count = len(floor.points)
    both = dense_surfels.scene(floor, roof, spacing=SPACING, roughness=np.ones(count + len(roof.points)))
    light = Relighter(both, Estimation(rays=0, brdf="lambert", bounces=1)).under(zenith)
    exposure = 0.3 / zenith.unoccluded(np.array([0.0, 0.0, 1.0])).mean()
    shown = eval_sh(baked(light, exposure, "none").sh[:count], np.array([0.0, 0.0, -1.0]))
    x, y, _ = np.abs(floor.points).T
    under, open_ = (x < 0.35) & (y < 0.35), (x > 1.0) & (y > 1.0)
    assert shown[under].max() < 0.1
    bright = to_display(np.full(3, 0.3 * 0.5), 1.0)
    np.testing.assert_allclose(np.median(shown[open_], axis=0), bright, atol=0.05)


@pytest.mark.parametrize("proxy", ["never", pytest.param("always", marks=pytest.mark.long)])
def test_pictures_that_no_fit_saw_are_those_of_the_light(scene, sun, proxy, short_film):
    """At 33 dB; the constant alone, which viewers without harmonics show, is worse on metal."""
    relighter = Relighter(scene, Estimation(rays=64), proxy=proxy)
    light = relighter.under(sun)
    relit = baked(light, 1.0, "none")
    assert len(relit) == len(scene)
    flat = replace(relit, sh=np.concatenate([relit.sh[:, :1], 0 * relit.sh[:, 1:]], axis=1))
    for turn in (0.5, 3.0):
        eye = (3 * np.cos(turn), 3 * np.sin(turn), 1.4)
        camera = Camera.look_at(eye, (0, 0, 0.4), fov_deg=40, width=96, height=96)
        frame = light.render(camera, background=(0, 0, 0))
        solid = frame.mask > 0.995
        truth = to_display(frame.lit, 1.0)[solid]
        least = 31 if proxy == "never" else 27
        assert psnr(drawn(relit, camera)[solid], truth) > max(least, psnr(drawn(flat, camera)[solid], truth))


def test_a_scene_without_signs_of_normals_is_baked_too(scene, sun):
    """Turned outward from the middle, as light sees it; the ball is the same from outside."""
    over = generator(0, "tests", "over").random(len(scene)) < 0.5
    ball = scene.metallic > 0
    one = baked(Relighter(scene, PREVIEW).under(sun), 1.0)
    signless = replace(scene.turned_over(over), oriented=False)
    other = baked(Relighter(signless, PREVIEW, proxy="never").under(sun), 1.0)
    outward = scene.normals()[ball]
    difference = eval_sh(one.sh[ball], -outward) - eval_sh(other.sh[ball], -outward)
    assert np.sqrt((difference**2).mean()) < 0.06


def test_from_behind_shows_what_lies_beyond_where_cameras_see_through(dense_surfels):
    """A red sheet before a blue one, seen from the red one's back: other viewers draw that."""
    red, blue = dense_surfels.plane(0.1, 1.0), dense_surfels.plane(0.1, 1.0)
    blue = replace(blue, points=blue.points + np.array([0, 0, 0.5]), normals=-blue.normals)
    color = np.repeat([[0.8, 0.05, 0.05], [0.05, 0.05, 0.8]], len(red.points), axis=0)
    sheets = dense_surfels.scene(red, blue, spacing=0.1, base_color=color)
    middle = np.flatnonzero(np.abs(red.points).max(axis=1) < 0.4)
    for oriented in (True, False):
        scene = replace(sheets, oriented=oriented)
        light = Relighter(scene, PREVIEW, proxy="never").under(EnvironmentMap.constant(1.0))
        sh = baked(light, 1.0).sh[middle]
        r, _, b = eval_sh(sh, np.array([0.0, 0.0, 1.0])).mean(axis=0)
        assert (b > r) == oriented
        r, _, b = eval_sh(sh, np.array([0.0, 0.0, -1.0])).mean(axis=0)
        assert r > b


def test_light_that_does_not_bounce_is_refused(scene, sun):
    with pytest.raises(TronError, match="bounces=1"):
        baked(Relighter(scene, Estimation(bounces=0)).under(sun), 1.0)

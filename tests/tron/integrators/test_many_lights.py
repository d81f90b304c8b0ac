"""Laws of ``tron_many_lights``: under each light what Mitsuba's ``path`` renders of it alone."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import integrators
from tron.brdf.bsdf import register_bsdf
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.integrators.many_lights import StackedLights, hilbert_order
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("registered")

CAMERA = Camera.look_at((2.2, -2.6, 1.5), (0, 0, 0.35), fov_deg=38, width=24, height=16)


@pytest.fixture
def registered(variant) -> None:
    integrators.register()
    register_bsdf()


def lights() -> list[EnvironmentMap]:
    """A sun of two texels in a dim sky, a lamp at the zenith over black, and coloured noise."""
    sun = np.full((33, 66, 3), (0.1, 0.15, 0.25), np.float32)
    sun[9, 20:22] = (90.0, 80.0, 60.0)
    lamp = np.zeros((33, 66, 3), np.float32)
    lamp[:4] = (3.0, 2.0, 1.0)
    noise = generator(3, "many lights").random((33, 66, 3)).astype(np.float32)
    return [EnvironmentMap(image) for image in (sun, lamp, noise)]


def shapes() -> dict[str, Any]:
    """A floor, a bumpy textured ball seen from both sides, a glossy metal one, and a wall."""
    rng = generator(4, "many lights")
    bumps = mi.Bitmap((0.5 + 0.5 * _unit(rng.normal(size=(16, 16, 3)) * 0.3 + (0, 0, 1))).astype(np.float32))
    colors = mi.Bitmap(rng.uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32))
    textured = {"type": "bitmap", "bitmap": colors, "raw": True}
    bumpy = {
        "type": "normalmap",
        "normalmap": {"type": "bitmap", "bitmap": bumps, "raw": True},
        "bsdf": {"type": "metallicroughness", "base_color": textured, "roughness": 0.4},
    }
    metal = {"type": "metallicroughness", "base_color": {"type": "rgb", "value": [0.9, 0.6, 0.3]}}
    white = {"type": "metallicroughness", "base_color": {"type": "rgb", "value": 0.7}, "roughness": 0.8}
    place = mi.ScalarTransform4f()
    return {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": place.scale(2.0), "bsdf": white},
        "wall": {
            "type": "rectangle",
            "to_world": place.translate([-1, 0, 0]).rotate([0, 1, 0], 90),
            "bsdf": {"type": "twosided", "bsdf": white},
        },
        "bumpy": {
            "type": "sphere", "center": [0.0, 0.5, 0.45], "radius": 0.45,
            "bsdf": {"type": "twosided", "bsdf": bumpy},
        },
        "metal": {
            "type": "sphere", "center": [0.3, -0.5, 0.4], "radius": 0.4,
            "bsdf": metal | {"metallic": 1.0, "roughness": 0.15},
        },
    }  # fmt: skip


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int, **film: Any) -> np.ndarray:
    description = mitsuba_sensor(CAMERA, spp, **film)
    description["sampler"]["type"] = "multijitter"
    image = mi.render(scene, sensor=mi.load_dict(description), integrator=integrator, spp=spp, seed=seed)
    return np.array(image, np.float64)


def plugin(environments: list[EnvironmentMap], **properties: Any) -> mi.Integrator:
    carried = integrators.embed(environments)
    return mi.load_dict({"type": "tron_many_lights", "lights": carried, **properties})


def together(count: int, spp: int, batches: int, **properties: Any) -> np.ndarray:
    """(batches, N, H, W, 3 or 4): renderings with seeds of their own."""
    integrator, hides = plugin(lights(), **properties), properties.get("hide_emitters", False)
    scene, form = mi.load_dict(shapes()), "rgba" if hides else "rgb"
    found = []
    for batch in range(batches):
        image = render(scene, integrator, spp, integer(5, "together", batch), pixel_format=form)
        first = 4 if hides else 3
        colors = image[..., first:].reshape(*image.shape[:2], count, 3)
        if hides:
            alpha = np.broadcast_to(image[..., None, 3:4], (*colors.shape[:3], 1))
            colors = np.concatenate([colors, alpha], axis=-1)
        found.append(np.moveaxis(colors, 2, 0))
    return np.stack(found)


def one_by_one(spp: int, batches: int, **properties: Any) -> np.ndarray:
    """As :func:`together`, by Mitsuba's own path tracer."""
    depth = properties.get("max_depth", 6)
    hides = properties.get("hide_emitters", False)
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": hides})
    found = []
    for number, light in enumerate(lights()):
        scene = mi.load_dict(shapes() | {"light": light.to_mitsuba()})
        seeds = [integer(6, "alone", number, batch) for batch in range(batches)]
        form = "rgba" if hides else "rgb"
        found.append([render(scene, integrator, spp, seed, pixel_format=form) for seed in seeds])
    return np.stack(found, axis=1)


def agree(ours: np.ndarray, theirs: np.ndarray, bias: float) -> None:
    """Pixels differ by no more than noise, and so little of it together that ``bias`` would be seen."""
    count = len(ours)
    difference = ours.mean(0) - theirs.mean(0)
    # Neighbours share what is known of the noise: a handful of batches says little of one pixel's.
    variance = (ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / count
    for light in range(ours.shape[1]):
        z = difference[light] / np.sqrt(variance[light] + 1e-12)
        # Student's t with 2 count - 2 degrees of freedom has a variance of its own.
        freedom = 2 * count - 2
        assert np.sqrt((z**2).mean()) < 1.25 * np.sqrt(freedom / (freedom - 2)), light
        assert np.abs(np.median(z)) < 0.2, light
        assert abs(difference[light].mean()) <= bias * theirs[:, light].mean(), light


def test_each_light_is_as_path_renders_it_alone():
    agree(together(3, 225, 6), one_by_one(225, 6), bias=0.005)


def test_hidden_light_leaves_radiance_times_coverage():
    ours = together(3, 144, 6, hide_emitters=True)
    theirs = one_by_one(144, 6, hide_emitters=True)
    assert 0.2 < theirs[..., 3].mean() < 0.95
    agree(ours, theirs, bias=0.01)


@pytest.mark.parametrize("depth", [1, 3])
def test_paths_end_where_those_of_path_do(depth):
    agree(together(3, 144, 6, max_depth=depth), one_by_one(144, 6, max_depth=depth), bias=0.01)


@pytest.mark.long
def test_nothing_is_lost_by_four_thousandths():
    agree(together(3, 1024, 16), one_by_one(1024, 16), bias=0.004)


def test_a_white_room_under_white_light_is_white():
    """Furnace: convex and diffuse, what arrives leaves, whatever is drawn."""
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": white}})
    constant = [EnvironmentMap.constant(value, height=8) for value in (1.0, 3.0)]
    image = render(scene, plugin(constant), 64, 1)
    colors = image[..., 3:].reshape(-1, 2, 3)
    np.testing.assert_allclose(colors.mean((0, 2)), (1.0, 3.0), rtol=2e-3)
    np.testing.assert_allclose(colors[:, 0] * 3, colors[:, 1], rtol=1e-4)


def test_main_channels_are_the_mean_of_the_lights_and_the_same_seed_gives_the_same_bits():
    scene, integrator = mi.load_dict(shapes()), plugin(lights())
    first, second = (render(scene, integrator, 16, 7) for _ in range(2))
    colors = first[..., 3:].reshape(*first.shape[:2], 3, 3)
    np.testing.assert_allclose(first[..., :3], colors.mean(2), rtol=1e-4)
    assert integrator.aov_names()[3:6] == ["light1.R", "light1.G", "light1.B"]
    if str(mi.variant()).startswith("llvm"):
        np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(33, 66), (8, 16), (20, 40)])
def test_samples_measure_each_light(size):
    """The mean of L / density over samples is each light's integral, in closed form 4 pi its mean."""
    rng = generator(8, "stacked", size[0])
    images = rng.random((3, *size, 3)).astype(np.float32)
    images[1, 2, 5] = 500.0
    images[2, 0] += 20.0
    maps = [EnvironmentMap(image) for image in images]
    stacked = StackedLights(maps)
    count = 2**18
    u = [mi.Float(rng.random(count, np.float32)) for _ in range(2)]
    along = (dr.arange(mi.Float, count) + mi.Float(rng.random(count, np.float32))) / count
    texel = stacked.sample(along, mi.Point2f(*u), mi.Bool(True))
    # Of the hats that overlap at a direction each is drawn for itself, so the weight has no hat in it.
    found = stacked.add([mi.Color3f(0)] * 3, texel.index, mi.Color3f(1 / texel.density), mi.Bool(True))
    for color, light in zip(found, maps):
        np.testing.assert_allclose(np.array(color).mean(1), 4 * np.pi * light.mean(), rtol=0.01)


def test_directions_find_the_radiance_and_density_of_the_texels_above_them():
    maps = lights()
    stacked, count = StackedLights(maps), 2**16
    d = _unit(generator(9, "seen").normal(size=(count, 3)))
    direction = mi.Vector3f(*(mi.Float(np.ascontiguousarray(part, np.float32)) for part in d.T))
    behind = stacked.background(direction, mi.Bool(True))
    for color, light in zip(behind, maps):
        np.testing.assert_allclose(np.array(color).T, light.lookup(d), rtol=2e-3, atol=2e-3)
    u = mi.Float(generator(9, "seen", "u").random(count, np.float32))
    texel = stacked.seen(direction, u, mi.Bool(True))
    picked = stacked.add([mi.Color3f(0)] * 3, texel.index, mi.Color3f(1), mi.Bool(True))
    for color, light in zip(picked, maps):
        np.testing.assert_allclose(np.array(color).mean(1), light.lookup(d).mean(0), rtol=0.05)
    # Uniform directions: the density's mean over the sphere is that of what it is a density of.
    assert np.array(texel.density).mean() * 4 * np.pi == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("shape", [(4, 4), (8, 8), (16, 16), (32, 64), (5, 9), (1, 2)])
def test_the_curve_meets_every_cell_once_and_neighbours_in_turn(shape):
    order = hilbert_order(*shape)
    assert len({tuple(cell) for cell in order.tolist()}) == shape[0] * shape[1] == len(order)
    steps = np.abs(np.diff(order, axis=0)).sum(1)
    if shape[0] == shape[1]:
        assert (steps == 1).all()
    else:
        assert (steps == 1).mean() > 0.7


def test_lights_that_do_not_fit_are_named():
    small, large = EnvironmentMap.constant(1.0, height=8), EnvironmentMap.constant(1.0, height=16)
    for given, word in (([small, large], "sizes 16 x 8 and 32 x 16"), ([], "no light"),
                        ([small.rotated(20.0)], "turned")):  # fmt: skip
        with pytest.raises(TronError, match=word):
            StackedLights(given)
    with pytest.raises(RuntimeError, match="no path or no shadow ray"):
        plugin([small], later_rays=0)

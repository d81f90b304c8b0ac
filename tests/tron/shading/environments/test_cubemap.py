"""Laws of the cubemap: continuous on the sphere, one with the lat-long map, and its gradients are honest."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.errors import TronError
from tron.seeds import generator
from tron.shading.environments.cubemap import CubemapLight, direction_face, face_direction
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.shading.lighting import Lighting, SplitSum


def unit(n: int, seed: int = 0) -> np.ndarray:
    d = generator(seed, "directions").normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def vector(a: np.ndarray) -> "mi.Vector3f":
    return mi.Vector3f(np.ascontiguousarray(a.T, dtype=np.float32))


def rows(a: object) -> np.ndarray:
    return np.array(a).T.astype(np.float64)


def random_texels(resolution: int, seed: int = 1) -> np.ndarray:
    return (generator(seed, "texels").random((6, resolution, resolution, 3)) ** 4 * 5).astype(np.float32)


def cubemap(texels: np.ndarray) -> CubemapLight:
    return CubemapLight(mi.Float(texels.ravel()), texels.shape[1])


def smooth_map(height: int = 128) -> EnvironmentMap:
    """Bands of low degree: everything that varies over less than about 30 degrees is absent."""
    light = EnvironmentMap(np.zeros((height, 2 * height, 3), np.float32))
    theta = np.arange(height)[:, None] / (height - 1) * np.pi
    phi = (np.arange(2 * height)[None] + 0.5) / height * np.pi
    x, y, z = np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta) + 0 * phi
    bands = [2 + x + 0.3 * y * z, 1.5 + z**3 + 0.2 * x * y, 2 - y + 0.5 * x * x * z]
    return EnvironmentMap(np.stack(bands, -1).astype(np.float32), light.rotation_deg)


def test_a_texel_stands_where_its_face_says(variant: str) -> None:
    texels = random_texels(8)
    face, row, column = (i.ravel() for i in np.indices((6, 8, 8)))
    d = face_direction(
        mi.UInt32(face.astype(np.uint32)),
        mi.Float(((column + 0.5) / 4 - 1).astype(np.float32)),
        mi.Float(((row + 0.5) / 4 - 1).astype(np.float32)),
    )
    np.testing.assert_allclose(rows(cubemap(texels).radiance(d)), texels.reshape(-1, 3), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("resolution", [2, 3, 16])
def test_radiance_is_continuous_across_edges_and_corners(variant: str, resolution: int) -> None:
    light = cubemap(random_texels(resolution))
    along = np.concatenate([np.linspace(-1, 1, 401), [-0.9999, 0.9999]])
    step, worst = 1e-5, 0.0
    for axis in range(3):
        for first in (1.0, -1.0):
            for second in (1.0, -1.0):
                edge = np.stack([np.full(along.size, first), np.full(along.size, second), along], 1)
                across = np.array([step * first, -step * second, 0])
                one, other = (
                    rows(light.radiance(vector(np.roll(e, axis, 1)))) for e in (edge + across, edge - across)
                )
                worst = max(worst, np.abs(one - other).max())
    assert worst < 20 * step * resolution  # a bilinear function of slope 5 R; the texels differ by up to 5


def test_the_one_hot_map_stands_where_mitsubas_plugin_shows_it(variant: str, cubemap_of) -> None:
    """Orientation: bright spots of a lat-long map, through the cubemap, against the plugin itself."""
    image = np.zeros((64, 128, 3), np.float32)
    for row, column, rgb in (
        (10, 20, (9, 0, 0)),
        (31, 70, (0, 9, 0)),
        (50, 101, (0, 0, 9)),
        (2, 60, (5, 5, 0)),
    ):
        image[row - 2 : row + 3, column - 2 : column + 3] = rgb
    environment = EnvironmentMap(image, 25.0)
    emitter = mi.load_dict(environment.to_mitsuba())
    d = unit(20000)
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = -vector(d)
    truth = rows(emitter.eval(si))
    ours = rows(cubemap_of(environment, 128).radiance(vector(d)))
    assert (truth.max(0) > 4).all()
    assert np.abs(ours - truth).mean() < 0.06 * truth.mean()
    for c in range(3):
        assert np.corrcoef(ours[:, c], truth[:, c])[0, 1] > 0.99


def test_a_smooth_map_survives_the_round_trip_within_a_hundredth(variant: str, cubemap_of) -> None:
    environment = smooth_map()
    back = cubemap_of(environment, 64).to_environment()
    d = unit(5000)
    seen, truth = back.lookup(d), environment.lookup(d)
    assert back.image.shape == environment.image.shape
    assert np.abs(seen / truth - 1).max() < 0.01
    np.testing.assert_allclose(back.mean(), environment.mean(), rtol=1e-3)


def test_conversions_keep_the_light_of_a_sun(variant: str, cubemap_of) -> None:
    image = np.full((64, 128, 3), 0.3, np.float32)
    image[20, 50] = 900.0
    environment = EnvironmentMap(image)
    there = cubemap_of(environment, 32)
    back = there.to_environment()
    np.testing.assert_allclose(back.mean(), environment.mean(), rtol=0.02)
    np.testing.assert_allclose(back.unoccluded_upward(), environment.unoccluded_upward(), rtol=0.02)


def test_cubemap_and_map_agree_in_every_filter(variant: str, cubemap_of) -> None:
    environment, d = smooth_map(), vector(unit(1000))
    light = cubemap_of(environment, 64)
    one, other = SplitSum(EnvironmentLight(environment), 64), SplitSum(light, 64)
    np.testing.assert_allclose(rows(other.diffuse(d)), rows(one.diffuse(d)), rtol=5e-3)
    for roughness in (0.1, 0.4, 0.9):
        np.testing.assert_allclose(
            rows(other.prefiltered(d, mi.Float(roughness))),
            rows(one.prefiltered(d, mi.Float(roughness))),
            rtol=1e-2,
        )
    np.testing.assert_allclose(
        rows(light.radiance(d)), rows(EnvironmentLight(environment).radiance(d)), rtol=1e-2
    )


def test_density_integrates_to_one_and_samples_follow_it(variant: str) -> None:
    texels = random_texels(6)
    texels[2, 1, 4] = 300.0
    light = cubemap(texels)
    d = unit(400_000)
    assert np.array(light.pdf(vector(d))).mean() * 4 * np.pi == pytest.approx(1, rel=0.02)

    n = 1 << 20
    u = mi.Point2f(generator(2, "u").random((2, n)).astype(np.float32))
    drawn, density = light.sample(u)
    # A direction on the edge of two faces may be read from either: one of these samples was, on a GPU.
    off = np.abs(np.array(density) / np.array(light.pdf(drawn)) - 1) > 1e-3
    assert off.mean() <= (1e-5 if variant.startswith("cuda") else 0)
    np.testing.assert_allclose(np.array(dr.norm(drawn)), 1, atol=1e-5)
    # Counts in a 3 x 3 grid within each texel, against the integral of the density over it.
    face, x, y = direction_face(drawn)
    cell = np.array((face * 18 + mi.UInt32((y + 1) * 9)) * 18 + mi.UInt32((x + 1) * 9))
    seen = np.bincount(cell, minlength=6 * 18 * 18)
    centre = [(np.arange(18) + 0.5) / 9 - 1] * 2
    v, u = np.meshgrid(*centre, indexing="ij")
    face = mi.UInt32(np.repeat(np.arange(6, dtype=np.uint32), 18 * 18))
    u, v = (np.tile(a.ravel(), 6).astype(np.float32) for a in (u, v))
    expected = np.array(light.pdf(face_direction(face, mi.Float(u), mi.Float(v)))) * n / 81
    expected *= (1 + u.astype(np.float64) ** 2 + v.astype(np.float64) ** 2) ** -1.5
    assert ((seen - expected) ** 2 / expected).mean() == pytest.approx(1, abs=0.15)


def test_density_reaches_every_direction_and_prefers_the_light(variant: str) -> None:
    texels = np.zeros((6, 16, 16, 3), np.float32)
    light = cubemap(texels)
    np.testing.assert_allclose(np.array(light.pdf(vector(unit(100)))), 1 / (4 * np.pi), rtol=0.7)
    texels[4, 3, 3] = 100.0
    d = unit(20000)
    light = cubemap(texels)
    density, radiance = np.array(light.pdf(vector(d))), rows(light.radiance(vector(d)))[:, 1]
    assert density.min() > 0
    assert density[radiance > 10].min() > 100 * np.median(density)


def test_a_ray_estimate_by_the_density_is_the_integral(variant: str) -> None:
    light = cubemap(random_texels(16))
    d, density = light.sample(mi.Point2f(generator(3, "u").random((2, 1 << 17)).astype(np.float32)))
    estimate = rows(light.radiance(d) / density) / (4 * np.pi)
    noise = estimate.std(0) / np.sqrt(len(estimate))
    assert (np.abs(estimate.mean(0) - light.to_environment(64).mean()) < 5 * noise + 2e-3).all()


def gradient(function, texels: np.ndarray) -> np.ndarray:
    values = mi.Float(texels.ravel())
    dr.enable_grad(values)
    dr.backward(dr.sum(function(CubemapLight(values, texels.shape[1]))))
    return np.array(dr.grad(values)).reshape(texels.shape)


def difference(function, texels: np.ndarray, towards: np.ndarray, step: float) -> float:
    """Central difference of the function along a direction, its sum taken in float64."""
    ends = [
        np.array(function(cubemap((texels + s * step * towards).astype(np.float32))), np.float64).sum()
        for s in (1, -1)
    ]
    return (ends[0] - ends[1]) / (2 * step)


def test_gradients_of_the_lookup(variant: str) -> None:
    texels = random_texels(4)
    # Directions everywhere, and right beside the edges and the corners.
    d = np.concatenate([unit(300), np.sign(unit(100)) + 0.01 * unit(100, 5)])
    weight = mi.Color3f(generator(4, "weight").normal(size=(3, len(d))).astype(np.float32))

    def function(light: CubemapLight) -> mi.Float:
        return dr.dot(light.radiance(vector(d)), weight)

    ours = gradient(function, texels)
    for seed in range(4):
        towards = generator(seed, "towards").normal(size=texels.shape)
        assert (ours * towards).sum() == pytest.approx(
            difference(function, texels, towards, 0.1), rel=2e-3, abs=1e-3
        )
    for face, row, column in ((0, 0, 0), (3, 3, 1), (5, 2, 2)):  # a corner, an edge, the inside
        towards = np.zeros(texels.shape)
        towards[face, row, column, 1] = 1
        assert ours[face, row, column, 1] == pytest.approx(
            difference(function, texels, towards, 0.1), rel=2e-3, abs=1e-3
        )


@pytest.mark.parametrize("term", ["diffuse", "rough", "sharp", "specular"])
def test_gradients_through_split_sum(variant: str, term: str) -> None:
    texels = 1 + random_texels(8)
    texels[1, 2, 2] = 40.0
    n, v = unit(60), unit(60, seed=3)
    v *= np.sign((n * v).sum(1))[:, None]
    weight = mi.Color3f(generator(4, "weight").normal(size=(3, 60)).astype(np.float32))

    def function(light: CubemapLight) -> mi.Float:
        filtered = SplitSum(light, 64)
        value = {
            "diffuse": lambda: filtered.diffuse(vector(n)),
            "rough": lambda: filtered.prefiltered(vector(n), mi.Float(0.6)),
            "sharp": lambda: filtered.prefiltered(vector(n), mi.Float(0.15)),
            "specular": lambda: filtered.reflected(vector(n), vector(v), mi.Float(0.3)),
        }[term]()
        return dr.dot(value, weight)

    ours = gradient(function, texels)
    assert np.abs(ours).max() > 0
    # A whole colour, and single texels: beside a corner, and the brightest, which draws centroids to itself.
    directions = [generator(s, "towards").normal(size=texels.shape) for s in range(3)]
    for face, row, column in ((0, 0, 0), (1, 2, 2)):
        directions.append(np.zeros(texels.shape))
        directions[-1][face, row, column] = (1, 2, 3)
    scale = float(np.linalg.norm(ours))
    for towards in directions:
        expected = difference(function, texels, towards, 0.02)
        assert (ours * towards).sum() == pytest.approx(expected, rel=0.01, abs=2e-3 * scale)


def test_split_sum_of_a_scaled_light_is_the_scaled_split_sum(variant: str) -> None:
    texels, d = random_texels(16), vector(unit(500))
    one, other = SplitSum(cubemap(texels), 64), SplitSum(cubemap(3 * texels), 64)
    for roughness in (0.1, 0.7):
        np.testing.assert_allclose(
            rows(other.prefiltered(d, mi.Float(roughness))),
            3 * rows(one.prefiltered(d, mi.Float(roughness))),
            rtol=1e-3,
        )


def test_wrong_sizes_are_refused(variant: str) -> None:
    with pytest.raises(TronError, match="no cubemap of 4"):
        CubemapLight(dr.zeros(mi.Float, 100), 4)
    with pytest.raises(TronError, match="no cubemap of 1"):
        CubemapLight(dr.zeros(mi.Float, 18), 1)


def test_a_cubemap_does_not_turn(variant: str) -> None:
    light = CubemapLight(mi.Float(np.ones(18 * 16**2, np.float32)), 16)
    with pytest.raises(TronError, match="does not turn"):
        Lighting(light, 64).turned_to(30.0)

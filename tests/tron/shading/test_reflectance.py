"""Laws of the reflectance table: its three columns are integrals of Mitsuba's own materials."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.seeds import generator
from tron.shading.brdf_table import BrdfTable, brdf_table
from tron.shading.reflectance import reflectance


def monte_carlo_albedo(cosine: float, alpha: float, n: int = 400_000) -> tuple[float, float]:
    """A and B by sampling half vectors from D n.h, float64; independent of visible normals."""
    random = generator(6, "brdf")
    u, phi = random.random(n), random.random(n) * 2 * np.pi
    cos_h = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
    sin_h = np.sqrt(1 - cos_h**2)
    view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    facing = view[0] * sin_h * np.cos(phi) + view[2] * cos_h
    out = 2 * facing * cos_h - cosine

    def smith(c: np.ndarray | float) -> np.ndarray:
        return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * np.square(c)))

    valid = (out > 0) & (facing > 0)
    weight = np.where(valid, smith(np.maximum(out, 1e-9)) * smith(cosine) * facing / (cosine * cos_h), 0)
    fresnel = (1 - np.clip(facing, 0, 1)) ** 5
    return float((weight * (1 - fresnel)).mean()), float((weight * fresnel).mean())


@pytest.mark.parametrize("row", [20, 64, 200])
@pytest.mark.parametrize("column", [12, 128, 250])
def test_table_is_the_albedo_by_monte_carlo(variant: str, row: int, column: int) -> None:
    expected = monte_carlo_albedo((column + 0.5) / 256, ((row + 0.5) / 256) ** 2)
    np.testing.assert_allclose(brdf_table()[row, column, :2], expected, atol=5e-3)


@pytest.mark.parametrize("row,column", [(30, 40), (100, 128), (180, 30), (250, 200)])
def test_table_is_the_albedo_of_mitsubas_rough_conductor(variant: str, row: int, column: int) -> None:
    alpha, cosine = ((row + 0.5) / 256) ** 2, (column + 0.5) / 256
    mirror = mi.load_dict(
        {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}
    )
    n = 1 << 18
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    u = mi.Point2f(generator(7, "u").random((2, n)).astype(np.float32))
    _, weight = mirror.sample(mi.BSDFContext(), si, mi.Float(0), u)
    assert brdf_table()[row, column, :2].sum() == pytest.approx(np.array(weight[0]).mean(), abs=3e-3)


def uniform_light(roughness: float, cosine: float, base: float, metallic: float = 0.0) -> float:
    """Radiance of Mitsuba's principled material under uniform light of 1, by directions of light alone."""
    values = {"base_color": {"type": "rgb", "value": base}, "roughness": roughness, "metallic": metallic}
    bsdf = mi.load_dict({"type": "principled", "specular": 0.5, **values})
    n = 1 << 20
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    u = mi.Point2f(generator(8, "u").random((2, n)).astype(np.float32))
    out = mi.warp.square_to_cosine_hemisphere(u)
    value = bsdf.eval(mi.BSDFContext(), si, out)[0] / (out.z * dr.inv_pi)
    return float(np.array(value, np.float64).mean())


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("cosine", [0.05, 0.3, 0.9])
def test_the_diffuse_factor_is_that_of_mitsubas_principled(
    variant: str, roughness: float, cosine: float
) -> None:
    """White less black leaves the diffuse part, which is all that base color changes in a dielectric."""
    theirs = uniform_light(roughness, cosine, 1.0) - uniform_light(roughness, cosine, 0.0)
    factor = BrdfTable.load()(mi.Float(roughness), mi.Float(cosine))[2]
    assert factor[0] == pytest.approx(theirs, abs=4e-3)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.4, 0.8])
@pytest.mark.parametrize("cosine", [0.3, 0.8])
def test_reflectance_is_that_of_mitsubas_principled(
    variant: str, material, metallic: float, roughness: float, cosine: float
) -> None:
    share = reflectance(material(0.5, roughness, metallic), BrdfTable.load(), mi.Float(cosine))
    theirs = uniform_light(roughness, cosine, 0.5, metallic)
    assert share.diffuse.x[0] + share.specular.x[0] == pytest.approx(theirs, abs=6e-3)


def test_the_mean_over_directions_is_that_of_the_table(variant: str) -> None:
    roughness = mi.Float((np.arange(256) + 0.5) / 256)
    cosine = (np.arange(256) + 0.5) / 256
    expected = np.average(brdf_table(), axis=1, weights=cosine)
    for found, column in zip(BrdfTable.load()(roughness), expected.T):
        np.testing.assert_allclose(np.array(found), column, rtol=1e-5)
    np.testing.assert_allclose(expected[[0, 255], 2], [0.952, 1.065], atol=2e-3)


def test_lambert_knows_neither_roughness_nor_angle(variant: str, material) -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
    roughness, cosine = grid.T.astype(np.float32)
    share = reflectance(material(0.8, roughness, 0.25), BrdfTable.load(), mi.Float(cosine), diffuse="lambert")
    np.testing.assert_allclose(np.array(share.diffuse + dr.zeros(mi.Color3f, 81)), 0.6, rtol=1e-6)

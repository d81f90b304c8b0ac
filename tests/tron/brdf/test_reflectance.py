"""Laws of the table and of reflectance: integrals in float64, energy at every roughness and angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.brdf.bsdf import metallic_roughness
from tron.brdf.microfacets import seen_density, visible_normal
from tron.brdf.reflectance import glass_fresnel, lobe_parts, mean_fresnel, reflectance
from tron.brdf.table import BrdfTable, brdf_table
from tron.seeds import generator


def lobe_mean(surface, normal: mi.Vector3f, view: mi.Vector3f) -> mi.Vector3f:
    parts = lobe_parts(surface, BrdfTable.load(), normal, view)
    return sum((share * mean for share, mean in parts), mi.Vector3f(0))


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
    hidden = 1 / smith(np.maximum(out, 1e-9)) + 1 / smith(cosine) - 1  # heights correlated
    weight = np.where(valid, facing / (hidden * cosine * cos_h), 0)
    fresnel = (1 - np.clip(facing, 0, 1)) ** 5
    return float((weight * (1 - fresnel)).mean()), float((weight * fresnel).mean())


@pytest.mark.parametrize("row", [20, 64, 200])
@pytest.mark.parametrize("column", [12, 128, 250])
def test_table_is_the_albedo_by_monte_carlo(variant: str, row: int, column: int) -> None:
    expected = monte_carlo_albedo((column + 0.5) / 256, (row / 255) ** 2)
    np.testing.assert_allclose(brdf_table()[row, column, :2], expected, atol=5e-3)


@pytest.mark.parametrize("roughness", [0.05, 0.4, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
def test_white_keeps_all_light_at_every_angle_and_on_average(
    variant: str, material, roughness: float, metallic: float
) -> None:
    cosine = mi.Float(np.linspace(0.01, 1, 60).astype(np.float32))
    for view in (cosine, None):
        share = reflectance(material(1.0, roughness, metallic), BrdfTable.load(), view)
        np.testing.assert_allclose(np.array(share.diffuse + share.specular), 1, atol=2e-3)


def test_the_mean_of_fresnel_is_that_of_glass(variant: str) -> None:
    cosine = np.sqrt((np.arange(100_000, dtype=np.float64) + 0.5) / 100_000)
    mirrored = np.array(mi.fresnel(mi.Float(cosine.astype(np.float32)), 1.5)[0], np.float64)
    assert glass_fresnel() == pytest.approx(mirrored.mean(), abs=1e-5)
    assert mean_fresnel(np.array(0.04)) == pytest.approx(0.04 + 0.96 / 21)


def test_the_mean_over_directions_is_that_of_the_table(variant: str) -> None:
    roughness = mi.Float(np.arange(256) / 255)
    cosine = (np.arange(256) + 0.5) / 256
    expected = np.average(brdf_table(), axis=1, weights=cosine)
    for found, column in zip(BrdfTable.load()(roughness), expected.T):
        np.testing.assert_allclose(np.array(found), column, rtol=1e-5)


def test_lambert_knows_neither_roughness_nor_angle(variant: str, material) -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
    roughness, cosine = grid.T.astype(np.float32)
    share = reflectance(material(0.8, roughness, 0.25), BrdfTable.load(), mi.Float(cosine), brdf="lambert")
    np.testing.assert_allclose(np.array(share.diffuse + dr.zeros(mi.Color3f, 81)), 0.6, rtol=1e-6)


@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_the_mean_of_a_lobe_is_that_of_the_light_that_the_path_tracer_draws(
    variant: str, material, roughness: float, cosine: float, metallic: float
) -> None:
    """Of a black dielectric or a metal there is nothing but the lobe; the mean is of Schlick's Fresnel."""
    base = 0.6 if metallic else 0.0
    bsdf, n = metallic_roughness(base, roughness, metallic), 1 << 18
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    random = generator(9, "tests", "lobe mean").random((3, n)).astype(np.float32)
    drawn, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(random[0]), mi.Point2f(random[1:]))
    weight = np.array(weight.x, np.float64)
    expected = (np.array(drawn.wo, np.float64) * weight).sum(1) / weight.sum()
    up, view = mi.Vector3f(0, 0, 1), mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    mean = lobe_mean(material(base, roughness, metallic), up, view)
    np.testing.assert_allclose(np.array(mean).ravel(), expected, atol=0.012 if metallic else 0.05)


@pytest.mark.parametrize("degrees", [0.0, 0.5, 2.0, 5.0, 60.0, 89.0])
def test_a_mirror_mirrors_at_every_angle(variant: str, material, degrees: float) -> None:
    """Where it is faced most of all: within 3.6 degrees all were looked up at 3.6."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    view = mi.Vector3f(float(sine), 0, float(cosine))
    mean = lobe_mean(material(0.8, 0.0, 1.0), mi.Vector3f(0, 0, 1), view)
    assert np.array(mean).ravel() == pytest.approx([-sine, 0, cosine], abs=1e-3)


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("base_color", [0.0, 0.8])
def test_the_mean_of_a_lobe_is_differentiable_where_the_surface_is_faced(
    variant: str, material, behind: bool, base_color: float
) -> None:
    normal, view = mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, -1 if behind else 1)
    dr.enable_grad(normal)
    mean = lobe_mean(material(base_color, 0.3, 1.0), normal, view)
    assert float(dr.norm(dr.detach(mean))[0]) > 0.1
    dr.backward(dr.sum(mean))
    assert np.abs(np.array(dr.grad(normal))).max() < 10


@pytest.mark.parametrize("alpha", [4e-4, 1e-3, 0.1])
def test_narrow_lobes_have_the_density_that_they_are_drawn_by(variant: str, alpha: float) -> None:
    """Against float64. By the cosine of the half vector it was off by up to six times, or infinite."""
    count, cosine = 1 << 14, 0.5
    view = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    half = visible_normal(
        view, mi.Float(alpha), mi.Point2f(generator(3, "tests").random((2, count), np.float32))
    )
    x, y, z = np.array(half, np.float64) / np.linalg.norm(np.array(half, np.float64), axis=0)
    distribution = alpha**2 / (np.pi * (alpha**2 * z**2 + x**2 + y**2) ** 2)
    exact = distribution / (2 * (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2)))
    assert np.array(seen_density(view.z, half, mi.Float(alpha))) == pytest.approx(exact, rel=1e-3)


def test_base_colors_beyond_one_make_no_lobe_endless(variant: str, material) -> None:
    """A float image may hold some: at 2 a rough lobe's factor was in the thousands, and negative."""
    roughness = np.linspace(0, 1, 101)
    shares = reflectance(material(2.0, roughness, 1.0), BrdfTable.load(), mi.Float(0.5)).specular.x
    assert 1.5 < np.array(shares).min() <= np.array(shares).max() < 2.1

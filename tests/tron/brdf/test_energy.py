"""Laws of energy: split-sum reflects at most what arrives, over every roughness, angle and material."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tron.brdf.reflectance import DIELECTRIC_F0, reflectance
from tron.brdf.table import brdf_table
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.shading.lighting import SplitSum


@pytest.fixture
def furnace(variant: str) -> SplitSum:
    return SplitSum(EnvironmentLight(EnvironmentMap.constant(1.0)), 64)


def every_case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines n.v, roughnesses and reflectances F0 at the normal, with ends beyond the outermost texels."""
    cosine = np.concatenate([[1e-4, 1e-3, 0.999, 1.0], np.linspace(0.01, 0.99, 40)])
    roughness = np.concatenate([[0.0, 1e-3, 1.0], np.linspace(0.01, 0.99, 40)])
    grid = np.meshgrid(cosine, roughness, [0.0, DIELECTRIC_F0, 0.3, 1.0], indexing="ij")
    return tuple(values.ravel().astype(np.float32) for values in grid)  # type: ignore[return-value]


def test_the_table_never_reflects_more_than_all(variant: str) -> None:
    table = brdf_table()
    assert table[..., :4].min() >= 0
    assert table[..., :2].sum(-1).max() <= 1 + 1e-5  # float32


def test_white_and_other_surfaces_in_a_furnace(furnace: SplitSum, material) -> None:
    cosine, roughness, f0 = every_case()
    view = np.stack([np.sqrt(np.maximum(1 - cosine**2, 0)), 0 * cosine, cosine])
    normal = mi.Vector3f(0, 0, 1)
    metal = reflectance(material(f0, roughness, 1.0), furnace.brdf, mi.Float(cosine), "lambert")
    seen = np.array(furnace.reflected(normal, mi.Vector3f(view), mi.Float(roughness)) * metal.specular)[0]
    assert np.isfinite(seen).all()
    assert seen.max() <= 1 + 1e-4
    assert seen.min() >= 0
    brighter = seen.reshape(-1, 4)  # more reflectance at the normal is more at every angle
    assert (np.diff(brighter, axis=1) >= -1e-6).all()
    mirror = (roughness < 0.01) & (f0 == 1) & (cosine > 0.05)
    assert seen[mirror].min() > 0.99


def test_a_smooth_dielectric_follows_schlick(furnace: SplitSum, material) -> None:
    """F0 + (1 - F0) (1 - n.v)^5: where roughness vanishes the lobe is a mirror's."""
    cosine = np.linspace(0.05, 1, 60).astype(np.float32)
    view = mi.Vector3f(np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine]))
    black = reflectance(material(0.0, 0.02, 0.0), furnace.brdf, view.z, "lambert")
    seen = furnace.reflected(mi.Vector3f(0, 0, 1), view, mi.Float(0.02)) * black.specular
    expected = DIELECTRIC_F0 + (1 - DIELECTRIC_F0) * (1 - cosine) ** 5
    np.testing.assert_allclose(np.array(seen)[0], expected, atol=0.01)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
def test_no_material_reflects_more_than_arrives(furnace: SplitSum, material, metallic: float) -> None:
    """Diffuse and specular together, at every angle and on average."""
    cosine, roughness, base = every_case()
    for view in (mi.Float(cosine), None):
        share = reflectance(material(base, roughness, metallic), furnace.brdf, view)
        total = np.array(share.diffuse + share.specular)
        assert np.isfinite(total).all()
        assert total.max() <= 1 + 2e-3  # of a mixture of metal; either alone is 1e-5
        assert np.array(share.diffuse).min() >= -1e-5

"""Laws of ``metallicroughness``: white keeps all light, samples follow their density."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

from tron.brdf.bsdf import metallic_roughness
from tron.brdf.reflectance import reflectance
from tron.brdf.table import BrdfTable
from tron.seeds import generator

N = 1 << 18


def seen_from(cosine: float, lanes: int = 1) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    return si


def uniform(count: int = N) -> mi.Point2f:
    return mi.Point2f(generator(5, "tests", "bsdf").random((2, count)).astype(np.float32))


def albedo(bsdf: mi.BSDF, cosine: float) -> float:
    """By its own sampling; the mean over channels."""
    choice = mi.Float(generator(5, "tests", "choice").random(N, np.float32))
    _, weight = bsdf.sample(mi.BSDFContext(), seen_from(cosine, N), choice, uniform())
    return float(np.array(weight, np.float64).mean())


@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.03, 0.2, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [0.05, 0.3, 0.95])
def test_white_sends_out_all_that_arrives(
    variant: str, metallic: float, roughness: float, cosine: float
) -> None:
    assert albedo(metallic_roughness(1.0, roughness, metallic), cosine) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("cosine", [0.1, 0.3, 0.9])
def test_it_sends_out_what_its_reflectance_says(
    variant: str, material: Any, metallic: float, roughness: float, cosine: float
) -> None:
    share = reflectance(material(0.5, roughness, metallic), BrdfTable.load(), mi.Float(cosine))
    ours = share.diffuse.x[0] + share.specular.x[0]
    assert albedo(metallic_roughness(0.5, roughness, metallic), cosine) == pytest.approx(ours, abs=4e-3)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.3, 0.8])
@pytest.mark.parametrize("cosine", [0.15, 0.8])
def test_samples_follow_their_density(variant: str, metallic: float, roughness: float, cosine: float) -> None:
    """Pearson's test, as Mitsuba tests its own."""
    metallic_roughness(0.5, 0.5, 0.0)  # registers the plugin
    own = f"""
        <rgb name="base_color" value="0.7, 0.4, 0.2"/>
        <float name="roughness" value="{roughness}"/> <float name="metallic" value="{metallic}"/>
    """
    draw, density = BSDFAdapter("metallicroughness", own, wi=[float(np.sqrt(1 - cosine**2)), 0.0, cosine])
    test = ChiSquareTest(
        domain=SphericalDomain(), sample_func=draw, pdf_func=density, sample_dim=3, sample_count=200_000,
        ires=16,
    )  # fmt: skip
    assert test.run()


def test_its_value_is_the_weight_of_its_samples(variant: str) -> None:
    bsdf, si = metallic_roughness({"type": "rgb", "value": [0.9, 0.5, 0.1]}, 0.4, 0.3), seen_from(0.6, 256)
    choice = mi.Float(generator(5, "tests", "choice").random(256, np.float32))
    drawn, weight = bsdf.sample(mi.BSDFContext(), si, choice, uniform(256))
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, drawn.wo)
    there = np.array(drawn.pdf) > 0
    np.testing.assert_allclose(np.array(density)[there], np.array(drawn.pdf)[there], rtol=1e-4)
    np.testing.assert_allclose(
        np.array(value)[:, there], np.array(weight * drawn.pdf)[:, there], rtol=1e-4, atol=1e-6
    )


def test_nothing_leaves_below_the_surface_or_towards_its_back(variant: str) -> None:
    bsdf, below = metallic_roughness(1.0, 0.5, 0.5), mi.Vector3f(0.6, 0, -0.8)
    assert np.array(bsdf.eval(mi.BSDFContext(), seen_from(0.5), below)).max() == 0
    assert np.array(bsdf.eval(mi.BSDFContext(), seen_from(-0.5), mi.Vector3f(0, 0, 1))).max() == 0
    both = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    front = bsdf.eval(mi.BSDFContext(), seen_from(0.5), mi.Vector3f(0, 0.6, 0.8))
    back = both.eval(mi.BSDFContext(), seen_from(-0.5), mi.Vector3f(0, 0.6, -0.8))
    np.testing.assert_allclose(np.array(back), np.array(front), rtol=1e-6)


@pytest.mark.parametrize("name", ["base_color", "roughness", "metallic"])
def test_its_parameters_have_the_derivatives_of_finite_differences(variant: str, name: str) -> None:
    values = {"base_color": 0.5, "roughness": 0.45, "metallic": 0.4}
    toward = mi.Vector3f(0.3, 0.2, float(np.sqrt(1 - 0.13)))

    def shown(given: dict[str, float]) -> float:
        made = metallic_roughness(*(given[key] for key in values))
        return float(made.eval(mi.BSDFContext(), seen_from(0.6), toward).x[0])

    bsdf = metallic_roughness(*values.values())
    parameters = mi.traverse(bsdf)
    key = f"{name}.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), seen_from(0.6), toward).x))
    found = float(np.array(dr.grad(parameters[key])).sum())
    step = 5e-3
    expected = (shown(values | {name: values[name] + step}) - shown(values | {name: values[name] - step})) / (
        2 * step
    )
    assert found == pytest.approx(expected, rel=0.02, abs=2e-3)


def test_textures_are_read_by_name(variant: str) -> None:
    bsdf = metallic_roughness({"type": "rgb", "value": [0.2, 0.4, 0.6]}, 0.3, 0.7)
    si = seen_from(1.0)
    np.testing.assert_allclose(np.array(bsdf.eval_attribute_3("base_color", si)).ravel(), [0.2, 0.4, 0.6])
    assert bsdf.eval_attribute_1("roughness", si)[0] == pytest.approx(0.3)
    assert bsdf.eval_attribute_1("metallic", si)[0] == pytest.approx(0.7)

"""A material is a function of the point: bounded, repeatable, and blended by one pattern."""

import numpy as np
import pytest

from datagen.materials.pattern import PATTERNS_OF_STYLE, draw_pattern, pattern
from tron.seeds import generator

PATTERNS = sorted({name for names in PATTERNS_OF_STYLE.values() for name in names})


def material(name, **changes):
    drawn = draw_pattern(generator(3, "material"), "A")
    values = {
        "pattern": name,
        "frequency": 1.3,
        "color_a": (0.9, 0.1, 0.1),
        "color_b": (0.1, 0.2, 0.8),
    } | changes
    return drawn.model_copy(update=values)


@pytest.fixture(scope="module")
def points():
    return generator(0, "points").uniform(-1.5, 1.5, (20_000, 3))


@pytest.mark.parametrize("name", PATTERNS)
def test_weights_lie_in_the_unit_interval_and_use_it(name, points):
    weight = pattern(material(name), points)
    assert weight.min() >= 0
    assert weight.max() <= 1
    if name != "plain":
        assert weight.std() > 0.15, "a pattern must be seen"


@pytest.mark.parametrize("name", PATTERNS)
def test_a_point_has_one_colour_whatever_else_is_evaluated(name, points):
    whole = pattern(material(name), points)
    np.testing.assert_array_equal(pattern(material(name), points[100:200]), whole[100:200])


@pytest.mark.parametrize("name", [name for name in PATTERNS if name != "plain"])
def test_floors_are_patterned_in_the_plane(name):
    drawn = [draw_pattern(generator(i, "floor"), "A", floor=True) for i in range(4)]
    assert all(each.pattern != "plain" and each.metallic == (0.0, 0.0) for each in drawn)
    x, y = np.meshgrid(np.linspace(-3, 3, 120), np.linspace(-3, 3, 120))
    weight = pattern(
        material(name, axis=drawn[0].axis), np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    )
    assert weight.std() > 0.1


def test_parameters_blend_by_the_pattern(points):
    spec = material("stripes", roughness=(0.2, 0.8), metallic=(1.0, 0.0))
    weight = pattern(spec, points)
    base_color, roughness, metallic, height = spec.evaluate(points, np.zeros_like(points))
    np.testing.assert_allclose(metallic, weight, atol=1e-6)
    assert not height.any()
    np.testing.assert_allclose(roughness, 0.8 - 0.6 * weight, atol=1e-6)
    np.testing.assert_allclose(base_color[:, 0], 0.1 + 0.8 * weight, atol=1e-6)


def test_drawn_materials_are_physical():
    for style in PATTERNS_OF_STYLE:
        for i in range(50):
            drawn = draw_pattern(generator(i, "m"), style)
            assert drawn.pattern in PATTERNS_OF_STYLE[style]
            assert all(0 <= c <= 1 for c in (*drawn.color_a, *drawn.color_b, *drawn.metallic))
            assert all(0.2 <= r <= 0.95 for r in drawn.roughness), "mirrors make fireflies at few samples"

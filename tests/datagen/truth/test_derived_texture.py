"""What the data engine's surfaces send out: never more than arrives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.models.parts import Part
from tron.models.shapes import highest, limited, textured


def mean_albedo(base: float, roughness: float, metallic: float, count: int = 40_000) -> float:
    """Share of light that Mitsuba's ``principled`` sends out, averaged over views, by its own sampling."""
    bsdf = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "rgb", "value": [base] * 3},
            "roughness": roughness,
            "metallic": metallic,
            "specular": 0.5,
        }
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    chosen, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return float(dr.mean(dr.select(chosen.pdf > 0, weight.x, 0))[0])


@pytest.mark.parametrize("roughness", [0.05, 0.4, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
def test_no_surface_makes_light_at_the_limit(variant, roughness, metallic):
    assert mean_albedo(float(highest(metallic)), roughness, metallic) <= 1.0 + 1e-3


def test_without_the_limit_white_paint_makes_light(variant):
    assert mean_albedo(1.0, 1.0, 0.0) > 1.03


def test_a_dielectric_is_limited_and_a_metal_is_not():
    color, metallic = np.full((1, 3, 3), 0.97, np.float32), np.array([0.0, 0.5, 1.0]).reshape(1, 3, 1)
    assert limited(color, metallic)[0, :, 0] == pytest.approx([0.85, 0.925, 0.97])
    dark = np.full((1, 3, 3), 0.4, np.float32)
    assert np.array_equal(limited(dark, metallic), dark)


def test_the_true_base_color_of_a_white_model_is_the_limited_one(variant):
    """A white texture, half dielectric and half metal, under a tint: what the G-buffers read."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    metallic = np.zeros((2, 2), np.float32)
    metallic[:, 1] = 1
    part = Part(
        vertices=corners,
        normals=np.tile([0.0, 0, 1], (4, 1)),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=corners[:, :2].astype(np.float32),
        base_color=np.full((2, 2, 3), 0.98, np.float32),
        roughness=1.0,
        metallic=metallic,
        normal_map=None,
        tint=np.ones((4, 3), np.float32),
    )
    surface = textured(part, "part")
    scene = mi.load_dict({"type": "scene", "shape": surface.shape})
    rays = mi.Ray3f(mi.Point3f([0.25, 0.75], [0.3, 0.3], [1.0, 1.0]), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(rays)
    true = np.array(surface.principled.eval_attribute_3("base_color", si, True)).T
    assert true[0] == pytest.approx([0.85] * 3, abs=1e-5)
    assert true[1] == pytest.approx([0.98] * 3, abs=1e-5)

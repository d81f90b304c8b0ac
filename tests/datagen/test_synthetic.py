"""The figures that surfels and guidance must reach on views and lights they were not made from."""

import numpy as np
import pytest

from datagen.build import build
from datagen.lights import Family
from datagen.pathtrace import direct_irradiance, gbuffers
from datagen.scene import draw_scene
from datagen.synthetic import first_bad_value
from tron import metrics
from tron.color import luminance, to_display
from tron.estimation import Estimation
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.shading.guidance import Lighting, render_guidance
from tron.tracing import SurfelTracer

SIZE = 96
LEAST_DB: dict[Family, float] = {"sun": 26.0, "studio": 26.0, "overcast": 28.0}


def test_values_that_are_not_finite_are_found_where_they_are():
    frames = [{"pbr": np.zeros((2, 3, 3)), "irradiance": np.ones((2, 3, 3))} for _ in range(3)]
    assert first_bad_value(frames) is None
    frames[2]["irradiance"][1, 1] = (np.inf, 0, np.nan)
    assert first_bad_value(frames) == "frame 2: irradiance has 2 values that are not finite"


@pytest.mark.long
@pytest.mark.parametrize("index", [0, 1, 2])
def test_20k_surfels_and_their_irradiance_on_held_out_views_of_textured_scenes(index, variant):
    families = tuple(LEAST_DB)
    spec = draw_scene(0, "test", index, style="A", lights=families, frames=5, path_frames=24)
    geometry = build(spec)
    surfels = surfels_from_gbuffers(gbuffers(geometry, spec.views(32, 128, 128)), count=20_000)
    assert len(surfels) == pytest.approx(20_000, rel=0.02)
    tracer = SurfelTracer(surfels)
    leaking = shadowed = darkened = lit = 0
    for number, (family, light) in enumerate(zip(families, spec.lights)):
        environment = light.bake(128)
        camera = spec.clip(number, 5, SIZE, SIZE)[2]
        truth = gbuffers(geometry, [camera])[0]
        ours = render_guidance(tracer, camera, Lighting(environment), Estimation(rays=64), seed=number)
        direct = direct_irradiance(geometry, geometry.lit(environment), camera, 256, seed=number)

        seen = truth.valid
        assert metrics.psnr(ours.gbuffer["base_color"], truth.base_color, seen) >= 28
        assert metrics.angular_error_deg(ours.gbuffer["normal"], truth.normal, seen) <= 5
        shown = [
            np.asarray(to_display(image, environment.exposure()))
            for image in (ours.irradiance, direct.shadowed)
        ]
        assert metrics.psnr(shown[0], shown[1], seen) >= LEAST_DB[family], family

        # Errors of shadows are counted where both see the same surface.
        depth = np.linalg.norm(truth.position - camera.position, axis=-1)
        same = seen & (np.abs(depth - ours.gbuffer["depth"].reshape(depth.shape)) < 0.03)
        reference, open_sky, estimate = (
            np.asarray(luminance(image)) for image in (direct.shadowed, direct.unshadowed, ours.irradiance)
        )
        share = reference / np.maximum(open_sky, 1e-6)
        dark, bright = same & (share < 0.5), same & (share > 0.9)
        shadowed, lit = shadowed + dark.sum(), lit + bright.sum()
        leaking += (estimate > reference + 0.15 * reference[seen].mean())[dark].sum()
        darkened += (estimate < 0.75 * reference)[bright].sum()
    assert shadowed > 200
    assert leaking <= 0.02 * shadowed
    assert darkened <= 0.03 * lit

"""The filter for many rays: its variance is that of independent rays, noise goes, edges of shadows stay."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import luminance
from tron.estimation import Estimation
from tron.seeds import generator
from tron.shading.direct.noise import NoiseSums
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import render_guidance
from tron.shading.lighting import Lighting

LANES, RAYS = 4096, 32
VIEW = Camera.look_at((3.5, 0, 2.2), (0, 0, 0.4), fov_deg=40, width=96, height=96)


def test_the_variance_is_that_of_independent_rays(variant: str) -> None:
    """Against the spread of the share over pixels whose rays were all drawn alike."""
    draw = generator(0, "tests", "noise of shares")
    light = draw.uniform(0.5, 1.5, (RAYS, LANES)).astype(np.float32)
    arrives = (draw.random((RAYS, LANES)) < 0.3).astype(np.float32)
    sums, none = NoiseSums.none(LANES), mi.Vector3f(0, 0, 1)
    for first in range(0, RAYS, 4):
        rays = range(first, first + 4)
        sums.add(
            [none] * 4, [mi.Color3f(mi.Float(light[k])) for k in rays], [mi.Float(arrives[k]) for k in rays]
        )
    share = (light * arrives).sum(0) / light.sum(0)
    found = np.array(sums.variance(mi.Float(share.astype(np.float32))))
    assert found.mean() == pytest.approx(
        share.var(dtype=np.float64), rel=0.08
    )  # (n - 1) / n, and 4,096 draws
    dark = NoiseSums.none(LANES).variance(mi.Float(np.ones(LANES, np.float32)))
    assert not np.array(dark).any()


@pytest.mark.parametrize(
    ("light", "rays", "supersample", "most"),
    [
        ("sun", 16, 1, 1.05),
        ("sun", 64, 1, 1.05),
        ("sun", 64, 2, 0.9),
        ("soft", 64, 1, 0.35),
        ("soft", 64, 2, 0.5),
    ],
)
def test_noise_goes_and_edges_of_shadows_stay(
    variant: str, sphere_over_plane, sun_map, light: str, rays: int, supersample: int, most: float
) -> None:
    """Errors over those without the filter, of three seeds; the umbra gets no more light than it had."""
    even = EnvironmentMap(np.full((16, 32, 3), 0.7, np.float32))
    tracer, lighting = sphere_over_plane(), Lighting(sun_map if light == "sun" else even)

    def share(rays: int, seed: int, filtered: bool) -> np.ndarray:
        wanted = Estimation(rays=rays, supersample=supersample, filtered=filtered)
        found = render_guidance(tracer, VIEW, lighting, wanted, seed)
        return np.where(found.mask > 0, luminance(found.irradiance) / luminance(found.unshadowed), 1)

    truth = share(1024, 99, False)
    errors = {
        filtered: np.sqrt(np.mean([(share(rays, seed, filtered) - truth) ** 2 for seed in (1, 2, 3)]))
        for filtered in (False, True)
    }
    assert errors[True] < most * errors[False], errors
    deep = truth < (0.5 if light == "sun" else 0.9)
    assert share(rays, 1, True)[deep].mean() == pytest.approx(truth[deep].mean(), abs=0.01)

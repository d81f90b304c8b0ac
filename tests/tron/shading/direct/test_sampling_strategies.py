"""Laws of multiple importance sampling under a small sun, for every orientation of the surface.

No strategy is the best for every normal. Where the sun shines, the light's own rays carry all of it, and the
half of MIS's rays that follow the cosine are nearly lost: its variance is about twice that of light rays.
Where the sun is hidden or below the horizon, light rays miss the sky and are ten times worse than both kinds.
What MIS gives is a bound: against n rays of any one kind, n / 2 of each leave at most

    V_mis <= 2 V_one + mean^2 / n          (Veach 1997, theorem 9.2)

and so the least relative error over all normals, both in the mean and at worst.
"""

from __future__ import annotations

import numpy as np
import pytest

from tron.seeds import generator
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap

NORMALS, COPIES = 240, 256
STRATEGIES = ("mis", "cosine", "light")
_POLAR, _TURN = 46.5 / 255 * np.pi, 121 / 512 * 2 * np.pi
SUN = np.array([np.sin(_POLAR) * np.sin(_TURN), np.sin(_POLAR) * np.cos(_TURN), np.cos(_POLAR)])


@pytest.fixture
def small_sun() -> EnvironmentLight:
    """1.4 degrees, a dim sky and a dark ground."""
    image = np.full((256, 512, 3), 0.3, np.float32)
    image[129:] = 0.1
    image[46:48, 120:122] = (25000, 22000, 16000)
    environment = EnvironmentMap(image)
    assert environment.lookup(SUN).min() > 10000
    return EnvironmentLight(environment)


@pytest.mark.parametrize("spp", [2, 16, 64])
def test_both_kinds_of_rays_together_are_never_far_from_the_better_and_best_at_worst(
    variant: str, sphere_over_plane, points_gbuffer, small_sun, spp: int
) -> None:
    normals = generator(0, "directions").normal(size=(NORMALS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gbuffer = points_gbuffer(
        np.tile([0.3, 0.2, 0.01], (NORMALS * COPIES, 1)), np.repeat(normals, COPIES, axis=0)
    )
    mean, variance = {}, {}
    for strategy in STRATEGIES:
        color = irradiance(sphere_over_plane(), gbuffer, small_sun, spp, 5, strategy)[0]
        value = np.array(color)[1].astype(np.float64).reshape(NORMALS, COPIES)
        mean[strategy], variance[strategy] = value.mean(1), value.var(1)
    truth = mean["mis"]
    noise = np.sqrt((variance["mis"] + variance["light"]) / COPIES)
    assert (np.abs(mean["light"] - truth) < 5 * noise).mean() > 0.99
    assert abs(mean["light"].mean() / truth.mean() - 1) < 0.005

    uncertain = 1.5  # an estimate of a variance from 256 values may be off by so much
    assert (variance["mis"] <= uncertain * (2 * variance["light"] + truth**2 / spp)).all()
    # Where cosine rays might find the sun, they do so too seldom for their variance to be known.
    night = normals @ SUN < -0.1
    assert 0.3 < night.mean() < 0.6
    assert (variance["mis"] <= uncertain * (2 * variance["cosine"] + truth**2 / spp))[night].all()

    relative = {strategy: variance[strategy] / truth**2 for strategy in STRATEGIES}
    for other in ("light", "cosine"):
        assert relative["mis"].mean() < 0.25 * relative[other].mean()
        assert relative["mis"].max() < 0.25 * relative[other].max()
    sunny = truth > 1
    assert 0.2 < sunny.mean() < 0.5
    assert variance["mis"][~sunny].mean() < 0.35 * variance["light"][~sunny].mean()
    assert variance["mis"][sunny].mean() < 2.5 * variance["light"][sunny].mean()
    assert variance["mis"].mean() < 0.01 * variance["cosine"].mean()

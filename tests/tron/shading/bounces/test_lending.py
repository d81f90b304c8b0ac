"""Light of surfels in place of shadow rays from pixels: lent among neighbours, composited, no ray traced."""

import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import PREVIEW, Estimation
from tron.relighting import Relighter
from tron.seeds import generator, integer
from tron.shading.bounces.bounce import BOUNCED_VALUES, SHOWN_RAYS, at_surfels
from tron.shading.bounces.lending import Lending
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

VIEW = Camera.look_at((1.5, -2.5, 2.0), (0, 0, 0.2), fov_deg=45, width=64, height=64)


@pytest.fixture(scope="module")
def scene(dense_surfels):
    return dense_surfels.scene(dense_surfels.plane(half=1.5), dense_surfels.sphere(radius=0.4, height=0.6))


def test_neighbours_lend_what_is_alike_and_nothing_across_an_edge(dense_surfels):
    box = dense_surfels.scene(dense_surfels.box())
    lending, random = Lending.among(box), generator(0, "lending")
    face = np.argmax(np.abs(box.normals()), axis=1) + 3 * (box.normals().sum(axis=1) > 0)
    of_face = np.stack([face, face == 2, np.ones(len(face))], axis=1).astype(np.float32)
    lent = lending.lent([*mi.Color3f(of_face.T)])
    np.testing.assert_allclose(np.stack(lent, axis=1), of_face, rtol=1e-5)
    noise = random.random((3, len(face)), np.float32)
    left = np.stack(lending.lent([*mi.Color3f(noise)]))
    assert left.mean() == pytest.approx(noise.mean(), abs=0.01)
    assert left.std() < 0.5 * noise.std()


@pytest.mark.parametrize("light", ["sun", "sky"])
def test_light_of_surfels_is_that_of_many_rays_from_pixels(scene, sun_map, light):
    """As near to 1,024 rays a pixel as two filtered ones, but for the edge of a hard shadow."""
    environment = sun_map if light == "sun" else EnvironmentMap.constant(1.0)
    lit = Relighter(scene, PREVIEW).under(environment)
    frames = {
        rays: lit.framed(rays=rays, filtered=rays == 2).render(VIEW).irradiance for rays in (0, 2, 1024)
    }
    error = {rays: np.sqrt(((frames[rays] - frames[1024]) ** 2).mean()) for rays in (0, 2)}
    assert error[0] < (1.2 if light == "sun" else 0.8) * error[2]
    shade = frames[1024].mean(axis=2) < 0.5 * np.median(frames[1024])
    assert frames[0][shade].mean() == pytest.approx(frames[1024][shade].mean(), rel=0.25)


@pytest.mark.parametrize("supersample", [1, 2])
def test_a_preview_traces_no_shadow_ray(scene, sun_map, monkeypatch, supersample):
    lit = Relighter(scene, PREVIEW).under(sun_map).framed(supersample=supersample)
    first = lit.render(VIEW)
    monkeypatch.setattr(SurfelTracer, "transmittances", None)
    np.testing.assert_array_equal(lit.render(VIEW).lit, first.lit)


def test_what_frames_are_given_is_lent(scene, sun_map):
    lit = Relighter(scene, PREVIEW).under(sun_map)
    transport, seed = lit.relighter.transport, integer(lit.seed, "shown")
    shown = at_surfels(PREVIEW).model_copy(update={"rays": SHOWN_RAYS})
    own = transport.reaching(lit.lighting, shown, seed, lent=False)
    assert lit.bounced is not None
    given = lit.bounced.values(0)[BOUNCED_VALUES:]
    np.testing.assert_array_equal(np.stack(given), np.stack(Lending.among(scene).lent(own)))
    assert np.abs(np.stack(given) - np.stack(own)).max() > 0.01


def test_where_nothing_is_baked_pixels_have_two_rays(scene, sun_map):
    alone = Relighter(scene, Estimation(rays=0, filtered=True, bounces=0)).under(sun_map).render(VIEW)
    two = Relighter(scene, Estimation(rays=2, filtered=True, bounces=0)).under(sun_map).render(VIEW)
    np.testing.assert_array_equal(alone.lit, two.lit)
    # Of surfels without a sign the side that is seen may not be the one that was baked.
    blind = type(scene)(**{**vars(scene), "oriented": False})
    frames = [
        Relighter(blind, Estimation(rays=rays, filtered=True), proxy="never").under(sun_map).render(VIEW).lit
        for rays in (0, 2)
    ]
    np.testing.assert_array_equal(*frames)

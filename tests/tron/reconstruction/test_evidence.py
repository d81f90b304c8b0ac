"""Laws of evidence over views: medians by group, exposures, colours where surfels are."""

from __future__ import annotations

import numpy as np
import pytest

from tron.reconstruction.evidence import gather_evidence, grouped_median
from tron.reconstruction.observations import Observations, bilinear, observe
from tron.seeds import generator
from tron.tracing import SurfelTracer


def observations(surfel: np.ndarray, view: np.ndarray, color: np.ndarray, **other) -> Observations:
    order = np.argsort(surfel, kind="stable")
    towards = np.tile([0.0, 0.0, 1.0], (len(surfel), 1))
    clipped = other.get("clipped", np.zeros(len(surfel), bool))
    return Observations(
        surfel[order],
        view[order],
        color[order],
        towards,
        clipped[order],
        int(surfel.max()) + 1,
        int(view.max()) + 1,
    )


def test_medians_by_group_are_numpy_s() -> None:
    draw = generator(0, "tests", "medians")
    group = np.sort(draw.integers(0, 40, 300))
    values = draw.normal(size=(300, 3))
    found = grouped_median(values, group, 41)
    for number in range(40):
        np.testing.assert_allclose(found[number], np.median(values[group == number], axis=0))
    assert not found[40].any()


def test_exposures_of_photos_are_found_and_colours_freed_of_them() -> None:
    draw = generator(1, "tests", "exposures")
    truth, gain = draw.uniform(0.05, 0.8, (500, 3)), np.exp(draw.normal(0, 0.2, (20, 3)))
    gain /= np.exp(np.log(gain).mean(0))
    surfel, view = (index.ravel() for index in np.meshgrid(np.arange(500), np.arange(20), indexing="ij"))
    color = truth[surfel] * gain[view]
    glare = draw.random(len(surfel)) < 0.15  # highlights and bystanders
    color[glare] *= draw.uniform(2, 5, (glare.sum(), 1))
    found = gather_evidence(observations(surfel, view, color))
    np.testing.assert_allclose(np.log(found.gain), np.log(gain), atol=0.02)
    np.testing.assert_allclose(np.log(found.gain).mean(0), 0, atol=1e-6)
    assert np.median(np.abs(np.log(found.color / truth))) < 0.01
    alike = gather_evidence(observations(surfel, view, color), same_exposure=True)
    assert (alike.gain == 1).all()
    assert np.median(np.abs(np.log(alike.color / truth))) > 0.02


def test_what_no_photo_shows_is_known_as_such() -> None:
    surfel = np.array([0, 0, 2])
    found = gather_evidence(observations(surfel, np.array([0, 1, 1]), np.full((3, 3), 0.3)))
    assert found.seen.tolist() == [True, False, True]
    assert not found.color[1].any()


def test_bilinear_is_exact_on_a_ramp() -> None:
    y, x = np.mgrid[0:6, 0:9] + 0.5
    place = generator(2, "tests").uniform(0.5, 5.5, (50, 2))
    np.testing.assert_allclose(bilinear(2 * x - y, place), 2 * place[:, 0] - place[:, 1], atol=1e-9)


def test_surfels_are_seen_as_the_photos_show_them(painted, painted_capture) -> None:
    # The photos are the surfels' own radiance, taken here for linear: what is seen is what was painted.
    tracer = SurfelTracer(painted)
    found = observe(tracer, painted_capture.train_views, 1.0, "srgb")
    assert (np.diff(found.surfel) >= 0).all()
    from tron.color import srgb_to_linear
    from tron.gaussians.harmonics import SH_C0

    painting = srgb_to_linear(np.clip(SH_C0 * painted.sh[:, 0] + 0.5, 0, 1))
    evidence = gather_evidence(found, same_exposure=True)
    seen = evidence.count >= 2
    assert seen.mean() > 0.4  # nine photos of 32 pixels
    error = np.abs(evidence.color - painting)[seen].mean() / painting.mean()
    shuffled = np.abs(np.roll(evidence.color, 7, 0) - painting)[seen].mean() / painting.mean()
    assert error < 0.08 < shuffled
    # Nothing is seen from behind.
    towards = np.einsum("nc,nc->n", painted.normals()[found.surfel], found.to_camera)
    assert towards.min() > 0.15


def test_a_hidden_surfel_is_not_seen(painted, painted_capture) -> None:
    """A ball of surfels inside the first sphere: no photo shows it."""
    from dataclasses import replace

    inner = replace(painted, means=painted.means * 1.0)
    first = painted.object_id == 1
    inner.means[~first] = np.array([-0.6, 0, 0]) + 0.2 * painted.normals()[~first]
    found = observe(SurfelTracer(inner), painted_capture.train_views, 1.0, "srgb")
    counts = np.bincount(found.surfel, minlength=len(inner))
    assert counts[~first].sum() < 0.01 * counts[first].sum()
    assert counts[first].mean() == pytest.approx(counts[first].mean())

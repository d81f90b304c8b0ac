"""Laws of the light's priors, on points with nothing in the way, whose transport is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tron.reconstruction.light import fit_pairs
from tron.reconstruction.light.fit_pairs import Light, LightSettings, Points, _spread, fit_light
from tron.reconstruction.light.sky_visibility import PhotographedSky, cube_texels
from tron.seeds import generator

RESOLUTION, COUNT = 4, 500
SETTINGS = LightSettings(resolution=RESOLUTION, rounds=1)


def lamp() -> np.ndarray:
    """(D, 3) radiance of a blue room with a warm lamp at +x."""
    directions, _ = cube_texels(RESOLUTION)
    return np.where(directions[:, :1] > 0.85, (6.0, 4.0, 2.0), (0.4, 0.5, 0.7))


def points_under(
    light: np.ndarray, base: np.ndarray | float = 0.5, *, upwards: bool = False, bounced: float = 0.0
) -> Points:
    """Points that face all ways, or within 50 degrees of up, in an open sky."""
    draw = generator(0, "tests", "open points")
    normal = draw.normal(size=(20 * COUNT, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal[normal[:, 2] > (np.cos(np.radians(50)) if upwards else -1)][:COUNT]
    directions, solid = cube_texels(RESOLUTION)
    transport = (np.maximum(normal @ directions.T, 0) * solid / np.pi).astype(np.float32)
    indirect = np.full((COUNT, 3), bounced, np.float32)
    color = base * (transport @ light + indirect)
    return Points(draw.uniform(-1, 1, (COUNT, 3)), normal, color, indirect, transport)


def patches() -> np.ndarray:
    """(COUNT, 3) base colors of four paints."""
    paints = generator(1, "tests", "paints").uniform(0.1, 0.9, (4, 3))
    return paints[generator(2, "tests", "paints").integers(0, 4, COUNT)]


def base_color(found: Light, points: Points) -> np.ndarray:
    return points.color / (found.irradiance(points) + points.bounced)


@pytest.mark.parametrize("brightest", [0.4, 0.8])
def test_the_scale_is_that_of_the_brightest_paint(variant: str, brightest: float) -> None:
    points = points_under(lamp(), patches())
    for unit in (1.0, 30.0):  # photos have any exposure
        scaled = replace(points, color=unit * points.color)
        found = fit_light(scaled, SETTINGS.model_copy(update={"brightest": brightest}), 0)
        largest = np.percentile(base_color(found, scaled).max(1), 95)
        assert largest == pytest.approx(brightest, rel=0.08)


@pytest.mark.parametrize("darkness", [0.1, 0.5])
def test_where_nothing_looks_it_is_as_dark_as_is_said(
    variant: str, darkness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_pairs, "_DARKNESS", darkness)
    directions, _ = cube_texels(RESOLUTION)
    points = points_under(lamp(), patches(), upwards=True)
    unseen = directions[:, 2] < -0.8
    assert points.transport[:, unseen].max() == 0
    texels = fit_light(points, SETTINGS, 0).texels
    # The radiance of a direction is the mean of its channels' logarithms.
    grey = np.exp(np.log(texels).mean(1))
    assert grey[unseen].mean() / grey.mean() == pytest.approx(darkness, rel=0.4)


def test_a_sky_that_photos_show_is_the_light_s(variant: str) -> None:
    """Below, where no point looks, the photos show an orange ground."""
    directions, _ = cube_texels(RESOLUTION)
    points = points_under(lamp(), patches(), upwards=True)
    below, orange = directions[:, 2] < -0.4, np.array([1.2, 0.6, 0.2])
    sky = PhotographedSky(np.where(below[:, None], orange, 0.0), below.astype(float))
    texels = fit_light(points, SETTINGS, 0, sky=sky).texels
    off = np.abs(np.log(texels[below] / orange))
    assert np.median(off) < 0.05
    assert off.max() < 0.5
    alone = fit_light(points, SETTINGS, 0).texels
    assert np.median(np.abs(np.log(alone[below] / orange))) > 0.3


def fineness(texels: np.ndarray) -> float:
    """Deviation of log radiance from the nearest light of one texel a face, by least squares."""
    log, coarse = np.log(texels[:, 1]), _spread(RESOLUTION, 1)
    return float(np.std(log - coarse @ np.linalg.lstsq(coarse, log, rcond=None)[0]))


def colourfulness(texels: np.ndarray) -> float:
    """Largest over smallest red against blue, in logarithms."""
    return float(np.ptp(np.log(texels[:, 0] / texels[:, 2])))


def test_fine_levels_and_colours_are_held_back_by_their_weights(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = points_under(lamp(), patches())
    free = fit_light(points, SETTINGS, 0).texels
    grey = fit_light(points, SETTINGS.model_copy(update={"grey": 100.0}), 0).texels
    monkeypatch.setattr(fit_pairs, "_SMOOTH", 100.0)
    smooth = fit_light(points, SETTINGS, 0).texels
    assert fineness(smooth) < 0.01 < 0.1 < fineness(free)
    assert colourfulness(grey) < 0.05 < 1 < colourfulness(free)
    assert fineness(grey) > 0.1


def test_the_lamp_is_found_whatever_the_paints_and_what_bounces(variant: str) -> None:
    """After one factor a channel, which paints could share."""
    truth = lamp()
    for bounced in (0.0, 0.8):
        points = points_under(truth, patches(), bounced=bounced)
        assert error(fit_light(points, SETTINGS, 0), points, truth) < 0.06
    # What bounces is not the lamp's: left out, shadows look too bright.
    untold = replace(points, bounced=np.zeros_like(points.bounced))
    assert error(fit_light(untold, SETTINGS, 0), points, truth) > 0.12


def error(found: Light, points: Points, truth: np.ndarray) -> float:
    """Relative error of direct light at the points after one factor a channel."""
    received, direct = found.irradiance(points), points.transport @ truth
    factor = (received * direct).sum(0) / (received**2).sum(0)
    return float(np.linalg.norm(factor * received - direct) / np.linalg.norm(direct))


def test_what_differs_in_colour_is_not_taken_for_a_shadow(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything that faces +x is light red, the rest dark blue, in a light that is the same everywhere.

    With a large ``ROBUST`` no pair is doubted for its difference: its weight alone spares the light.
    """
    even = np.full((6 * RESOLUTION**2, 3), 0.7)
    points = points_under(even)
    red = points.normal[:, 0] > 0
    paint = np.where(red[:, None], (0.8, 0.5, 0.4), (0.08, 0.12, 0.2))
    monkeypatch.setattr(fit_pairs, "ROBUST", 2.0)
    found = fit_light(replace(points, color=points.color / 0.5 * paint), SETTINGS, 0)
    received = found.irradiance(points).mean(1)
    assert received[red].mean() / received[~red].mean() == pytest.approx(1, abs=0.05)


def test_few_points_that_face_a_way_count_as_much_as_many(variant: str) -> None:
    """Of 81 points 80 face up: how dark it is at the sides is told by the other."""
    truth = lamp()
    whole, upwards = points_under(truth, patches()), points_under(truth, patches(), upwards=True)
    many = np.concatenate([np.arange(COUNT)] * 4)
    few = np.arange(0, COUNT, 20)
    mixed = Points(
        **{
            name: np.concatenate([getattr(upwards, name)[many], getattr(whole, name)[few]])
            for name in ("position", "normal", "color", "bounced", "transport")
        }
    )
    assert error(fit_light(mixed, SETTINGS, 0), whole, truth) < 0.03


def test_derivatives_are_those_of_the_loss(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By finite differences in float64, of all unknowns, the sun's too, and of each part of the loss.

    But of the dark prior, whose mean is held; what it does is seen above.
    """
    monkeypatch.setattr(fit_pairs, "_single", lambda values: np.ascontiguousarray(values, np.float64))
    monkeypatch.setattr(fit_pairs, "_DARK", 0.0)
    draw = generator(3, "tests", "derivatives")
    points = replace(points_under(lamp(), patches(), bounced=0.1), lobe=draw.uniform(0, 1, COUNT))
    sky = PhotographedSky(1.5 * lamp(), draw.uniform(0, 1, len(lamp())))
    settings = SETTINGS.model_copy(update={"scale": 1.0, "grey": 1.0})
    fit = fit_pairs._Fit(points, settings, 0, sky, None)
    begin = fit.values + draw.normal(0, 0.3, fit.values.shape)
    fit.values = begin
    fit.draw_pairs(0)
    _, gradient = fit.misfit()
    step = 1e-6
    for row, column in [(0, 0), (7, 1), (60, 2), (len(begin) - 2, 0), (len(begin) - 1, 1)]:
        losses = []
        for sign in (1, -1):
            fit.values = begin.copy()
            fit.values[row, column] += sign * step
            losses.append(fit.misfit()[0])
        numeric = (losses[0] - losses[1]) / (2 * step)
        assert gradient[row, column] == pytest.approx(numeric, rel=1e-4, abs=1e-8)

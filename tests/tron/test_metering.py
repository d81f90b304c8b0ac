"""The incident meter: a grey card before the subject looks grey, whatever that is made of."""

from dataclasses import replace

import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.metering import incident_exposure
from tron.relighting import Guidance, Relighter
from tron.shading.environments.environment import EnvironmentMap

CAMERA = Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=40, width=48, height=48)
TO_CAMERA = -CAMERA.forward
CARD = 1
"""Object id of the card."""

LIGHTS = {
    "sky": lambda d: 0.2 + (d[..., 2] > 0.0),
    "sun behind the camera": lambda d: 0.05 + 300.0 * (d @ (0.3, -0.9, 0.3) > 0.99),
    "sun on the right": lambda d: 0.05 + 300.0 * (d @ (0.8, -0.59, 0.1) > 0.99),
    "light behind the subject": lambda d: 0.3 + 2.0 * (d[..., 1] > 0.7),
}


def environment(name: str) -> EnvironmentMap:
    directions = EnvironmentMap.constant(1.0, 64).directions()
    radiance = np.asarray(LIGHTS[name](directions), np.float32)
    return EnvironmentMap(np.repeat(radiance[..., None], 3, axis=2))


@pytest.fixture(scope="module")
def ball(dense_surfels) -> GaussianScene:
    return dense_surfels.scene(dense_surfels.sphere(0.1, 0.9), spacing=0.1)


@pytest.fixture(scope="module")
def carded(dense_surfels) -> GaussianScene:
    """The ball behind a card that faces the camera, 18 % grey and dull."""
    ball, card = dense_surfels.sphere(0.1, 0.9), dense_surfels.plane(0.05, 0.3)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # +z to -y, which faces the camera
    card = dense_surfels.turned(card, turn)
    card = replace(card, points=card.points + np.array([0.0, -1.6, 0.0]))
    which = np.repeat([0, CARD], [len(ball.points), len(card.points)])
    return dense_surfels.scene(
        *(ball, card),
        spacing=0.05,
        object_id=which,
        base_color=np.full((len(which), 3), 0.18),
        roughness=np.ones(len(which)),
    )


def frame_of(scene: GaussianScene, light: EnvironmentMap) -> Guidance:
    return Relighter(scene, Estimation(rays=16)).under(light).render(CAMERA)


@pytest.mark.parametrize("name", list(LIGHTS))
def test_a_grey_card_before_the_subject_is_grey(ball, carded, name):
    light = environment(name)
    card = frame_of(carded, light).lit[21:27, 21:27]
    for base_color in (0.03, 0.4, 0.85):
        painted = replace(ball, base_color=np.full((len(ball), 3), base_color, np.float32))
        exposure = incident_exposure(frame_of(painted, light), light.unoccluded(TO_CAMERA))
        shown = 255 * np.asarray(to_display(card, exposure)).mean()
        assert 100 <= shown <= 140, (name, base_color)


def test_help_goes_towards_what_can_be_seen_and_no_further(ball):
    light = environment("sky")
    card, exposures = light.unoccluded(TO_CAMERA), []
    for base_color in (0.02, 0.18, 0.85):
        frame = frame_of(replace(ball, base_color=np.full((len(ball), 3), base_color, np.float32)), light)
        exposures.append(incident_exposure(frame, card, "photograph"))
    assert exposures[0] > exposures[1] > exposures[2]
    assert np.log2(exposures[0] / exposures[2]) <= 0.85 + 1e-6


def test_doors_that_are_closed_are_metered_behind(ball):
    """Where one tenth of the light comes in, a card gets one tenth."""
    light = environment("sky")
    frame, card = frame_of(ball, light), light.unoccluded(TO_CAMERA)
    open_air = incident_exposure(frame, card)
    names = ("irradiance", "indirect", "lit")
    dimmed = replace(frame, **{name: getattr(frame, name) * np.float32(0.1) for name in names})
    assert incident_exposure(dimmed, card) == pytest.approx(10 * open_air, rel=1e-3)


def test_no_light_is_one_line(ball):
    light = environment("sky")
    frame = frame_of(ball, light)
    names = ("irradiance", "unshadowed", "indirect", "lit")
    dark = replace(frame, **{name: np.zeros_like(getattr(frame, name)) for name in names})
    with pytest.raises(TronError, match="no light falls on the subject"):
        incident_exposure(dark, np.zeros(3))
    glowing = replace(dark, lit=np.full_like(dark.lit, 4.0))
    assert incident_exposure(glowing, np.zeros(3)) == pytest.approx(0.25, rel=0.6)  # up to 0.6 stops of help


def test_a_plane_in_the_open_is_lit_as_its_closed_form_says():
    light = environment("sky")
    assert light.unoccluded(np.array([0.0, 0, 1])) == pytest.approx(light.unoccluded_upward(), rel=2e-3)
    even = EnvironmentMap.constant(2.0, 32)
    assert even.unoccluded(np.array([0.6, 0.0, 0.8])) == pytest.approx(2.0, rel=2e-3)
    turned = environment("sun on the right").rotated(90)  # from the right to the back
    assert turned.unoccluded(np.array([0.0, 1, 0])) == pytest.approx(
        environment("sun on the right").unoccluded(np.array([1.0, 0, 0])), rel=2e-2
    )

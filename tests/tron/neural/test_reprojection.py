"""Averages along motion: textures stay, noise falls as a mean's does, hidden surfaces stay out."""

import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.flow import Match, surface_motion
from tron.neural.clips import OWN_WEIGHT, averaged

SIZE, FRAMES, DISTANCE = 48, 5, 4.0
CAMERAS = [
    Camera.look_at((0.13 * k, 0, 0), (0.13 * k, 1, 0), fov_deg=50, width=SIZE, height=SIZE)
    for k in range(FRAMES)
]
INNER = np.s_[6:-6, 6:-6]


def wall(camera: Camera) -> np.ndarray:
    """Distance of the plane y = DISTANCE along the rays."""
    return DISTANCE / camera.exact_rays()[..., 1]


def painted(camera: Camera, waves: float = 1.5) -> np.ndarray:
    """The wall's texture as a camera sees it: display values, functions of the place on the wall."""
    x, _, z = np.moveaxis(camera.position + camera.exact_rays() * wall(camera)[..., None], -1, 0)
    return np.stack([0.5 + 0.3 * np.sin(waves * x + c) * np.cos(waves * z - c) for c in range(3)], -1)


def motion_of_the_wall():
    return surface_motion(CAMERAS, lambda k: wall(CAMERAS[k]))


def test_a_still_texture_is_left_as_it_is_and_noise_falls():
    clean = {k: painted(camera) for k, camera in enumerate(CAMERAS)}
    np.testing.assert_allclose(averaged(clean, 2, motion_of_the_wall())[INNER], clean[2][INNER], atol=2e-3)
    random = seeds.generator(0, "test", "reprojection")
    noisy = {k: picture + random.normal(0, 0.05, picture.shape) for k, picture in clean.items()}
    left = averaged(noisy, 2, motion_of_the_wall()) - clean[2]
    # Noise of frames is independent; clipping, and the weights of bicubic samples, change little.
    weights = np.array([OWN_WEIGHT, 1, 1, 1, 1])
    expected = 0.05 * np.sqrt((weights**2).sum()) / weights.sum()
    assert left[INNER].std() == pytest.approx(expected, rel=0.15)


def test_a_fine_texture_stays_sharp():
    """Bilinear samples of these waves, seven pixels each, leave 0.97 of their contrast."""
    fine = {k: painted(camera, waves=8) for k, camera in enumerate(CAMERAS)}
    found = averaged(fine, 2, motion_of_the_wall())[INNER]
    kept = (found - found.mean()).std() / (fine[2][INNER] - fine[2][INNER].mean()).std()
    assert kept == pytest.approx(1, abs=0.005)


def test_without_motion_known_the_same_frames_would_smear():
    """The test above can fail: averaged in place, the texture is off many times as much."""
    clean = {k: painted(camera) for k, camera in enumerate(CAMERAS)}
    still = Match(np.zeros((SIZE, SIZE, 2)), np.ones((SIZE, SIZE), bool))
    sharp = np.abs(averaged(clean, 2, motion_of_the_wall()) - clean[2])[INNER].max()
    smeared = np.abs(averaged(clean, 2, lambda *_: still) - clean[2])[INNER].max()
    assert smeared > 5 * sharp


def test_what_another_frame_does_not_see_is_not_taken_from_it():
    red, blue = (np.full((8, 8, 3), color, np.float32) for color in ((0.9, 0.1, 0.1), (0.1, 0.1, 0.9)))
    seen = np.zeros((8, 8), bool)
    seen[:, 4:] = True
    speckled = red + seeds.generator(1, "test").normal(0, 0.2, red.shape)
    found = averaged({0: speckled, 1: blue}, 0, lambda *_: Match(np.zeros((8, 8, 2)), seen))
    np.testing.assert_allclose(found[:, :4], np.clip(speckled[:, :4], 0, 1), atol=1e-6)
    assert found[:, 4:, 0].mean() < speckled[:, 4:, 0].mean() - 0.03


def test_colours_that_are_nowhere_around_are_held_to_what_is():
    """A highlight that the other frame alone has does not come along."""
    grey = np.full((9, 9, 3), 0.4, np.float32) + seeds.generator(2, "test").normal(0, 0.01, (9, 9, 3))
    lit = grey + 0.5
    found = averaged({0: grey, 1: lit}, 0, lambda *_: Match(np.zeros((9, 9, 2)), np.ones((9, 9), bool)))
    assert np.abs(found - grey).max() < 0.03
    # Exactly: each pixel counts OWN_WEIGHT times, and once the most that the nine around it allow.
    around = grey[3:6, 3:6].reshape(9, 3).astype(np.float64)
    expected = (OWN_WEIGHT * grey[4, 4] + around.mean(0) + around.std(0)) / (OWN_WEIGHT + 1)
    np.testing.assert_allclose(found[4, 4], expected, atol=2e-5)


def test_displacements_that_lead_nowhere_are_no_numbers_and_do_no_harm():
    picture = np.full((6, 6, 3), 0.5, np.float32)
    nowhere = Match(np.full((6, 6, 2), np.nan), np.zeros((6, 6), bool))
    far = Match(np.full((6, 6, 2), 1e12), np.ones((6, 6), bool))
    np.testing.assert_allclose(averaged({0: picture, 1: picture}, 0, lambda *_: nowhere), picture)
    np.testing.assert_allclose(averaged({0: picture, 1: picture}, 0, lambda *_: far), picture)

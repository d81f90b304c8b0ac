"""Laws of stereo: the surface comes back from photographs alone, and where there is no texture it says so."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.metrics import angular_error_deg
from tron.reconstruction.geometry import stereo
from tron.reconstruction.geometry.initial import beginning
from tron.reconstruction.geometry.matching import Photograph
from tron.reconstruction.geometry.stereo import (
    StereoMaps,
    Swept,
    confirmed,
    most_side,
    neighbours,
    plane_depths,
    stereo_maps,
    swept,
)
from tron.reconstruction.settings import InitialSettings, StereoSettings
from tron.seeds import generator

pytestmark = pytest.mark.usefixtures("variant")

SIZE = 48
SETTINGS = StereoSettings(planes=40, least_angle=2, angle=20, most_angle=50)


def painted_ball(camera: Camera, name: str, *, flat: bool = False) -> View:
    """A ball of radius 0.7 about the origin before a dark room, its true depth and normals."""
    rays = camera.rays().astype(np.float64)
    along = -(rays @ camera.position)
    inside = 0.49 - (camera.position @ camera.position - along**2)
    depth = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)
    points = camera.position + depth[..., None] * rays
    paint = 0.5 + 0.2 * np.sin(11 * points + 3 * np.sin(7 * points[..., [1, 2, 0]]))
    image = np.where((depth > 0)[..., None], paint, 0.02)
    image = np.full_like(image, 0.5) if flat else image
    normal = np.where((depth > 0)[..., None], points / 0.7, 0)
    return View(
        name, camera, image, "display", depth=depth, normal=normal, mask=(depth > 0).astype(np.float32)
    )


@pytest.fixture(scope="session")
def truth(around: Callable[..., list[Camera]]) -> Capture:
    """Twenty-four views of the painted ball, with its true maps."""
    return Capture(tuple(painted_ball(c, f"{k:02d}") for k, c in enumerate(around(24, size=SIZE))))


def photos(capture: Capture, *, masks: bool = True, flat: bool = False) -> Capture:
    """The photos alone."""
    kept = (painted_ball(v.camera, v.name, flat=flat) if flat else v for v in capture.views)
    gone = ("depth", "normal") if masks else ("depth", "normal", "mask")
    return replace(capture, views=tuple(replace(view, **dict.fromkeys(gone)) for view in kept))


@pytest.fixture(scope="session")
def found(truth: Capture) -> StereoMaps:
    return stereo_maps(photos(truth), SETTINGS, seed=0)


def errors(capture: Capture, found: StereoMaps) -> tuple[float, float, float]:
    """Median relative depth error, mean angle of normals, share of the subject that has both."""
    depths, angles, shares = [], [], []
    for view, other in zip(capture.views, found.views, strict=True):
        depth, own = view.read("depth"), other.read("depth")
        known = (depth > 0) & (own > 0)
        depths.append((np.abs(own - depth) / np.maximum(depth, 1e-9))[known])
        angles.append(angular_error_deg(other.read("normal"), view.read("normal"), known))
        shares.append(known.sum() / (depth > 0).sum())
    return float(np.median(np.concatenate(depths))), float(np.mean(angles)), float(np.mean(shares))


def test_a_painted_ball_comes_back_from_its_photos(truth: Capture, found: StereoMaps) -> None:
    depth, angle, share = errors(truth, found)
    assert depth < 0.015  # a pixel covers 1.2 % of the distance
    assert angle < 12
    assert share > 0.75
    assert found.confident > 0.3


@pytest.mark.long
def test_depths_that_nobody_confirms_count_a_little_where_a_mask_tells_of_a_surface(
    truth: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of twelve planes, some depths are confirmed by no photo: they are left out, or fill the surface."""
    monkeypatch.setattr(stereo, "semi_global_cost", lambda cost, *_: cost)  # each pixel by itself
    few = SETTINGS.model_copy(update={"planes": 12, "confident": 0.8})
    shares = []
    for unsure in (0.0, 0.1):
        settings = few.model_copy(update={"unsure": unsure})
        shares.append(errors(truth, stereo_maps(photos(truth), settings, seed=0))[2])
    assert shares[1] > shares[0] + 0.05
    unmasked = replace(truth, views=photos(truth, masks=False).views[:8])
    bare = [stereo_maps(unmasked, few.model_copy(update={"unsure": u}), 0) for u in (0, 0.1)]
    for one, other in zip(bare[0].views, bare[1].views, strict=True):
        np.testing.assert_array_equal(one.read("depth"), other.read("depth"))


def test_nothing_is_found_beside_the_subject(truth: Capture, found: StereoMaps) -> None:
    for view, other in zip(truth.views, found.views, strict=True):
        assert not other.read("depth")[view.read("mask") < 0.5].any()


def test_surfels_begin_on_the_surface_and_face_outwards(truth: Capture) -> None:
    settings = InitialSettings(source="stereo", count=500, stereo=SETTINGS)
    first = beginning(photos(truth), settings, 0)
    assert first.source == "stereo"
    assert first.place == "near"
    radius = np.linalg.norm(first.scene.means, axis=1)
    assert np.median(np.abs(radius - 0.7)) < 0.04
    assert first.scene.opacities().min() > 0.85
    outward = first.scene.means / radius[:, None]
    normals = first.scene.normals()
    assert np.median((normals * outward).sum(1)) > 0.95


def test_a_plain_part_of_a_photo_has_no_depth(truth: Capture, found: StereoMaps) -> None:
    """The ball is grey above its equator: a match there is one of noise."""

    def half_grey(view: View) -> View:
        position = view.camera.position + view.read("depth")[..., None] * view.camera.rays()
        grey = (position[..., 2] > 0) & (view.read("depth") > 0)
        return replace(view, image=np.where(grey[..., None], 0.5, view.read()), depth=None, normal=None)

    views = tuple(half_grey(view) for view in truth.views)
    photographs = [Photograph.of(view, 512, "cpu") for view in views]
    textured = np.stack([p.textured(SETTINGS.radius).numpy() for p in photographs])
    depth = np.stack([view.read("depth") for view in truth.views])
    position = np.stack(
        [v.camera.position + v.read("depth")[..., None] * v.camera.rays() for v in truth.views]
    )
    top, bottom = (depth > 0) & (position[..., 2] > 0.2), (depth > 0) & (position[..., 2] < -0.2)
    assert textured[top].mean() < 0.4  # what borders on something else, 5 pixels of 34
    assert textured[bottom].mean() > 0.95
    plain = stereo_maps(replace(truth, views=views), SETTINGS, seed=0).confident
    assert plain < 0.68 * found.confident  # 0.24 of 0.42; were plain windows believed, 0.33


def test_photos_without_texture_are_said_to_show_nothing(
    truth: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    bare = photos(truth, masks=False, flat=True)
    bare = replace(bare, views=bare.views[:8])
    settings = InitialSettings(count=200, stereo=SETTINGS)
    with caplog.at_level(logging.WARNING):
        first = beginning(bare, settings, 0)
    assert first.source == "random"
    assert first.place == "anywhere"
    assert first.confident is not None
    assert first.confident < 0.05
    assert len([r for r in caplog.records if "stereo found" in r.message]) == 1
    sparse = replace(bare, points=generator(0, "sparse").normal(size=(40, 3)))
    with caplog.at_level(logging.WARNING):
        assert beginning(sparse, settings, 0).source == "points"


def test_sparse_points_bound_the_planes_of_a_view(truth: Capture) -> None:
    photograph = Photograph.of(truth.views[0], 512, "cpu")
    camera = truth.views[0].camera
    points = camera.position + np.linspace(2, 3, 200)[:, None] * camera.forward
    z = 1 / plane_depths(photograph, points, 32).numpy()
    assert z[0] == pytest.approx(0.95 * 2.005, rel=1e-3)
    assert z[-1] == pytest.approx(1.05 * 2.995, rel=1e-3)
    inverse = 1 / z
    np.testing.assert_allclose(np.diff(inverse), inverse[1] - inverse[0], rtol=1e-3)


def test_sparse_points_decide_where_photos_say_nothing(truth: Capture) -> None:
    flat = photos(truth, masks=False, flat=True)
    photographs = [Photograph.of(view, 512, "cpu") for view in flat.views]
    ball = generator(0, "ball").normal(size=(3000, 3))
    ball *= 0.7 / np.linalg.norm(ball, axis=1, keepdims=True)
    facing = ball @ photographs[0].camera.position > 1.5 * np.linalg.norm(ball, axis=1)
    beside = neighbours(photographs, ball, SETTINGS)
    depth = truth.views[0].read("depth")
    error = []
    for seeded in (True, False):
        found = swept(photographs, beside, 0, ball[facing], SETTINGS, seeded=seeded)
        error.append(float(np.median(np.abs(found.depth.numpy() - depth)[depth > 0])))
    assert error[0] < 0.05
    assert error[1] > 3 * error[0]


def test_neighbours_are_those_near_the_wanted_angle(truth: Capture) -> None:
    photographs = [Photograph.of(view, 512, "cpu") for view in truth.views]
    points = generator(0, "points").normal(size=(500, 3)) * 0.2
    chosen = neighbours(photographs, points, SETTINGS)
    towards = np.stack([p.camera.position / np.linalg.norm(p.camera.position) for p in photographs])
    for index, others in enumerate(chosen):
        assert index not in others
        assert 3 < len(set(others)) <= SETTINGS.neighbours
        angles = np.degrees(np.arccos(np.clip(towards @ towards[index], -1, 1)))
        fit = [k for k in range(24) if k != index and SETTINGS.least_angle < angles[k] < SETTINGS.most_angle]
        best = np.sort(np.abs(angles[fit] - SETTINGS.angle))[: SETTINGS.neighbours]
        assert np.abs(angles[others] - SETTINGS.angle).max() <= best.max() + 3


def test_a_photo_that_shows_another_place_is_no_neighbour() -> None:
    """Seen from the wanted angle, it looks away from what the first one shows."""
    places = [(0, -4, 0), (4 * np.sin(np.radians(20)), -4 * np.cos(np.radians(20)), 0), (1.0, -3.8, 0.6)]
    image = np.full((SIZE, SIZE, 3), 0.5)
    photographs = [
        Photograph.of(
            View(str(k), Camera.look_at(at, towards, fov_deg=30, width=SIZE, height=SIZE), image, "display"),
            512,
            "cpu",
        )
        for k, (at, towards) in enumerate(zip(places, [(0, 0, 0), (9, -9, 0), (0, 0, 0)]))
    ]
    points = generator(0, "two places").normal(size=(400, 3)) * 0.2
    assert neighbours(photographs, points, SETTINGS)[0] == [2]


def test_a_mask_hides_from_stereo_what_is_not_to_be_believed(truth: Capture) -> None:
    view, half = truth.views[0], np.ones((SIZE, SIZE), np.float32)
    half[:, :20] = 0
    whole = Photograph.of(view, 512, "cpu").subject.numpy()
    hidden = Photograph.of(replace(view, valid=half), 512, "cpu").subject.numpy()
    np.testing.assert_array_equal(hidden, whole & (half > 0))


def test_a_depth_that_other_photos_contradict_is_not_confirmed(truth: Capture) -> None:
    photographs = [Photograph.of(view, 512, "cpu") for view in truth.views]
    beside = neighbours(photographs, generator(0, "p").normal(size=(300, 3)) * 0.2, SETTINGS)
    depths = [torch.from_numpy(view.read("depth")) for view in truth.views]
    flat = torch.zeros_like(depths[0])
    right = [Swept(d, flat, flat > 0, 0.002) for d in depths]
    share = confirmed(photographs, beside, right)[0].sum() / (depths[0] > 0).sum()
    assert share > 0.8
    wrong = [Swept(0.9 * depths[0], flat, flat > 0, 0.002), *right[1:]]
    assert confirmed(photographs, beside, wrong)[0].sum() < 0.05 * (depths[0] > 0).sum()


def test_very_many_photographs_are_reduced_further(truth: Capture) -> None:
    assert most_side(truth.views, 512) == SIZE
    assert most_side(truth.views, 20) == 20
    many = truth.views * 2000  # 110 million pixels
    side = most_side(many, 512)
    assert len(many) * side**2 <= 1 << 25 < len(many) * (side + 1) ** 2

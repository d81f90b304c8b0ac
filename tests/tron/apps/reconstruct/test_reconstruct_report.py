"""The page of a reconstruction: films from where it was photographed, figures with ranges, gaps named."""

import base64
import io
import json
import re
from dataclasses import replace

import av
import numpy as np
import pytest

from tron.apps.reconstruct.report import (
    BALL,
    ball_pictures,
    film_cameras,
    mean_interval,
    showcase_films,
    showcase_lights,
    write_page,
)
from tron.apps.reconstruct.settings import ReportSettings
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import to_display
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer
from tron.trajectories import orbit, turn_cameras

MIDDLE = BALL // 2
SMALL = ReportSettings(frames=4, side=32, views=2)


def capture_of(cameras: list[Camera], scene, test: frozenset[str] = frozenset()) -> Capture:
    tracer, views = SurfelTracer(scene), []
    for number, camera in enumerate(cameras):
        image = np.clip(tracer.gbuffer(camera).numpy()["rgb"], 0, 1)
        views.append(View(f"v{number}", camera, image, "display"))
    return Capture(tuple(views), test, skipped={"lost.jpg": "image not found"})


def around(count: int, degrees: float) -> list[Camera]:
    """Cameras evenly over an arc."""
    cameras = orbit(
        round(count * 360 / degrees), target=(0, 0, 0.4), radius=4, width=24, height=20, fov_deg=40
    )
    return cameras[:count]


@pytest.fixture
def described() -> dict:
    return {
        "version": "1.2.3",
        "capture": {
            "path": "a/fox <b>", "up": [0, 0, 1], "views": 9,
            "held_out": ["v0", "v4"], "skipped": {"lost.jpg": "not found"},
        },
        "surfels": 1234,
        "materials_learnt": ["base_color"],
        "test": {"views": 2, "psnr": 28.0, "ssim": 0.9},
        "train": {"views": 2, "psnr": 31.0},
        "views": {
            "v0": {"psnr": 27.0, "ssim": 0.88}, "v4": {"psnr": 29.0, "ssim": 0.92}, "v1": {"psnr": 99.0},
        },
        "light": {"sigma": 1.5},
        "seconds": {"surfels": 61.0, "light": 4.0},
        "machine": {"cpu": "some processor"},
    }  # fmt: skip


def test_the_interval_is_students():
    # Of 26 to 30: standard error sqrt(0.5), and t of four degrees of freedom is 2.776.
    reach = 2.7764 * 0.5**0.5
    assert mean_interval([26.0, 27, 28, 29, 30]) == pytest.approx((28 - reach, 28 + reach), abs=1e-3)
    assert mean_interval([26.0, 27, 28, 29]) is None, "of fewer than five none is printed"
    rng, held = generator(0, "test student"), []
    for _ in range(2000):
        ends = mean_interval(rng.normal(5, 2, 6).tolist())
        assert ends is not None
        held.append(ends[0] < 5 < ends[1])
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)


def test_films_go_all_around_only_where_it_was_photographed_all_around(variant, ball_on_floor):
    scene = ball_on_floor(spacing=0.12)
    full = film_cameras(scene, capture_of(around(12, 360), scene), 8, 32)
    azimuths = np.sort([np.degrees(np.arctan2(*camera.position[1::-1])) for camera in full])
    assert len(full) == 8
    assert np.diff(azimuths).max() == pytest.approx(45, abs=1)

    arc = around(12, 120)
    path = film_cameras(scene, capture_of(arc, scene), 8, 32)
    assert len(path) == 8
    assert {(camera.width, camera.height) for camera in path} == {(32, 26)}  # the photos are 24 x 20
    positions = np.stack([camera.position for camera in path])
    photographed = np.stack([camera.position for camera in arc])
    ends = np.linalg.norm(positions[[0, -1], None] - photographed[[0, -1]], axis=-1)
    assert min(ends.trace(), ends[::-1].trace()) < 0.4  # from one end to the other, once
    assert np.linalg.norm(positions[:, None] - positions, axis=-1)[np.triu_indices(8, 1)].min() > 0.1
    nearest = np.linalg.norm(positions[:, None] - photographed, axis=-1).min(axis=1)
    assert nearest.max() < 0.5
    for camera in path:
        assert camera.project(np.array([[0, 0, 0.4]]))[1][0] > 2
        np.testing.assert_allclose(
            camera.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T, np.eye(3), atol=1e-9
        )


def test_films_hold_every_frame_and_differ_between_lights(variant, ball_on_floor):
    scene = ball_on_floor(spacing=0.12)
    films = showcase_films(scene, capture_of(around(9, 360), scene), 4, 32)
    means = []
    for name, video in films.items():
        with av.open(io.BytesIO(video), "r") as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) == 4
        assert frames[0].shape == (26, 32, 3)
        if name != "cloudy sky":  # it is alike all around, and so is a ball
            assert np.abs(frames[0].astype(float) - frames[2]).mean() > 5
        means.append(np.mean(frames, axis=0))
    assert len(films) == 3
    assert np.abs(means[0] - means[1]).mean() > 3


def test_a_scene_that_lies_on_its_side_is_filmed_from_above_its_own_floor(variant, ball_on_floor):
    scene = ball_on_floor(spacing=0.12)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    lying = scene.rotated(turn)
    capture = capture_of(turn_cameras(around(9, 360), turn), lying)
    cameras = film_cameras(lying, replace(capture, up=lying.up), 8, 32)
    heights = [camera.position @ lying.up for camera in cameras]
    assert min(heights) > 0.3
    below = [camera.world_to_camera[:3, :3] @ lying.up for camera in cameras]
    assert max(direction[1] for direction in below) < 0  # up is up in the pictures: y points down


def test_the_page_says_what_was_found_and_how_sure_it_is(variant, ball_on_floor, described, tmp_path):
    scene = ball_on_floor(spacing=0.12)
    capture = capture_of(around(9, 360), scene, frozenset({"v0", "v4"}))
    write_page(tmp_path / "report.html", SMALL, described, scene, capture, EnvironmentMap.constant(0.7, 16))
    page = (tmp_path / "report.html").read_text()
    for anchor in ("figures", "views", "light", "sure", "skipped", "made"):
        assert f'id="{anchor}"' in page
    assert "fox &lt;b&gt;" in page
    assert "<b>:" not in page
    videos = re.findall(r'<video src="data:video/mp4;base64,([^"]+)"', page)
    assert len(videos) == 3
    assert page.index("<video") < page.index('class="lead"') < page.index('class="tiles"')
    assert all(base64.b64decode(video)[4:8] == b"ftyp" for video in videos)
    assert page.count("<img src") == 2 * 9 + 3
    assert not re.search(r'(src|href)="https?:', page)
    assert "<script" not in page
    figures = page[page.index('id="figures"') : page.index('id="views"')]
    assert "28.00 dB" in figures
    assert "99.00" not in figures  # a training view's
    assert figures.index("27.00 dB") < figures.index("29.00 dB")  # worst, then best
    assert "lost.jpg" in page
    sure = page[page.index('id="sure"') : page.index('id="skipped"')]
    assert sure.count("not to be relied on") == 2  # roughness and metallic, that nobody taught
    assert "no truth in this capture" in sure
    assert "Held-out photos are met" in page
    assert "surfels that showed the sky" not in page


def test_what_the_joint_fit_says_of_itself_is_told(variant, ball_on_floor, described, tmp_path):
    scene = ball_on_floor(spacing=0.12)
    settings, capture = SMALL.model_copy(update={"frames": 0}), capture_of(around(9, 360), scene)
    sun = {"direction": [0.0, 0.866, 0.5], "width_deg": 3.2}
    described |= {"light": {"sun": sun, "surfels_seen": 0.93, "spread": 0.07}}
    write_page(tmp_path / "r.html", settings, described, scene, capture, EnvironmentMap.constant(1.0, 16))
    page = (tmp_path / "r.html").read_text()
    for each in ("a sun 3.2° wide stands 30° high", "which see 93% of the surfels", "a factor of 1.07"):
        assert each in page


def test_a_page_without_light_films_or_held_out_views_says_so(variant, ball_on_floor, described, tmp_path):
    scene = ball_on_floor(spacing=0.12)
    described |= {"light": None, "test": None, "views": {"v1": {"psnr": 99.0}}, "opened": 1234}
    described["capture"] |= {"held_out": [], "skipped": {}}
    settings = SMALL.model_copy(update={"frames": 0})
    write_page(tmp_path / "report.html", settings, described, scene, capture_of(around(9, 360), scene), None)
    page = (tmp_path / "report.html").read_text()
    for anchor in ("light", "skipped"):
        assert f'id="{anchor}"' not in page
    assert "No view was held out" in page
    assert "none was found" in page
    assert "1,234 surfels that showed the sky" in page, "a room is judged with its windows shut"
    assert json.dumps(described)  # nothing of what was given changed into something else


def test_a_page_of_a_scan_does_not_speak_of_photos(variant, ball_on_floor, described, tmp_path):
    scene = ball_on_floor(spacing=0.12)
    capture = replace(capture_of(around(9, 360), scene, frozenset({"v0", "v4"})), skipped={})
    described["capture"] |= {"path": "a/scan.ply", "skipped": {}}
    described |= {"first_surfels": {"source": "depth", "stereo_confident": 0.7}}
    described["light"] = {"sun": None, "surfels_seen": 0.93, "spread": 0.07}
    light, page = EnvironmentMap.constant(0.7, 16), tmp_path / "report.html"
    settings = SMALL.model_copy(update={"frames": 2})
    write_page(page, settings, described, scene, capture, light, "filmed view")
    words = re.sub(r"data:[^\"]*|<style>.*?</style>", "", page.read_text(), flags=re.DOTALL)
    assert "photo" not in words.lower()
    assert "scan.ply: from a scan of splats" in words
    assert "no sun explains" in words


def test_each_light_has_its_own_contrast(variant):
    contrast = {name: light.contrast() for name, light in showcase_lights().items()}
    assert contrast["low sun"] > 0.35
    assert 0.1 < contrast["soft boxes"] < 0.35
    assert contrast["cloudy sky"] < 0.05


def test_the_cloudy_sky_lights_a_plane_as_the_cie_sky_does(variant):
    # The integral of (1 + 2 sin e) / 3 against the cosine over the upper half is 7/9 of pi.
    found = showcase_lights()["cloudy sky"].unoccluded_upward()
    np.testing.assert_allclose(found, 7 / 9 * np.array([0.95, 1.0, 1.08]), rtol=0.02)


def test_in_even_light_a_mirror_ball_cannot_be_seen_and_a_matt_one_is_even(variant):
    mirror, matt = ball_pictures(EnvironmentMap.constant(0.6, 32), exposure=0.8)
    np.testing.assert_allclose(mirror, to_display(np.full((1, 1, 3), 0.6), 0.8) + 0 * mirror, atol=1e-5)
    grey = to_display(np.full((1, 1, 3), 0.5 * 0.6), 0.8)[0, 0]
    inside = matt[MIDDLE - 20 : MIDDLE + 20, MIDDLE - 20 : MIDDLE + 20]
    np.testing.assert_allclose(inside, grey + 0 * inside, atol=5e-3)


@pytest.mark.parametrize(
    "axis, sign, at", [(2, 1, "top"), (2, -1, "bottom"), (0, 1, "right"), (0, -1, "left")]
)
def test_balls_are_bright_on_the_side_that_light_comes_from(variant, axis, sign, at):
    empty = EnvironmentMap.constant(0.0, 32)
    half = (sign * empty.directions()[..., axis] > 0.3)[..., None] * np.ones(3)
    light = EnvironmentMap(half.astype(np.float32))
    edge = int(0.36 * BALL)
    pixel = {
        "top": (MIDDLE - edge, MIDDLE), "bottom": (MIDDLE + edge, MIDDLE),
        "right": (MIDDLE, MIDDLE + edge), "left": (MIDDLE, MIDDLE - edge),
    }  # fmt: skip
    opposite = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}[at]
    for ball in ball_pictures(light, exposure=1.0):
        assert ball[pixel[at]].mean() > ball[pixel[opposite]].mean() + 0.3


def test_a_mirror_ball_shows_behind_the_viewer_in_its_middle(variant):
    empty = EnvironmentMap.constant(0.0, 64)
    behind = (empty.directions()[..., 1] < -0.9)[..., None] * np.ones(3)
    mirror, _ = ball_pictures(EnvironmentMap(behind.astype(np.float32)), exposure=1.0)
    assert mirror[MIDDLE, MIDDLE].mean() > 0.5
    assert mirror[MIDDLE, MIDDLE + 40].mean() < 0.05

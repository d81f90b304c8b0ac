"""Panoramas become the six views that pinhole cameras in their place would have taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, LoadSettings, load_capture
from tron.captures.photos.panoramas import FACES, Panorama
from tron.errors import TronError
from tron.seeds import generator
from tron.shading import EnvironmentMap

SIZE = (1024, 512)
LEAST_PSNR = 40.0


def directions(size: tuple[int, int], part: tuple[float, float] = (0.5, 0.5)) -> np.ndarray:
    """(H, W, 3) world directions of a panorama's pixels, z forward, x right, y down, at a part of each."""
    longitude = ((np.arange(size[0]) + part[0]) / size[0] - 0.5) * 2 * np.pi
    latitude = ((np.arange(size[1])[:, None] + part[1]) / size[1] - 0.5) * np.pi
    level = np.cos(latitude)
    return np.stack(
        np.broadcast_arrays(level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)), -1
    )


def world() -> EnvironmentMap:
    """Light of soft blobs from everywhere, no two directions alike."""
    noise = generator(7, "panorama").random((24, 48, 3)).astype(np.float32)
    return EnvironmentMap(cv2.resize(noise, (256, 128), interpolation=cv2.INTER_CUBIC).clip(0, 1))


def seen(light: EnvironmentMap, rays: np.ndarray) -> np.ndarray:
    """Display values along OpenCV's directions; the light's z is up and y its middle."""
    return light.lookup(np.stack([rays[..., 0], rays[..., 2], -rays[..., 1]], axis=-1))


PARTS = [((i + 0.5) / 3, (j + 0.5) / 3) for i in range(3) for j in range(3)]


def panorama(light: EnvironmentMap, size: tuple[int, int] = SIZE) -> np.ndarray:
    """(H, W, 3) uint8: each pixel is the mean over its area."""
    mean = np.mean([seen(light, directions(size, part)) for part in PARTS], axis=0)
    return np.round(255 * mean).astype(np.uint8)


def in_place(folder: Path, write, picture: np.ndarray, count: int = 3, **frame: str) -> dict:
    """A capture of panoramas that look along z, one beside the other; the content of its transforms.json."""
    frames = []
    for index in range(count):
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[0, 3] = index
        write.save(folder / "images" / f"{index}.png", picture)
        own = {key: value.format(index) for key, value in frame.items()}
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": matrix.tolist(), **own})
    content = {"camera_model": "EQUIRECTANGULAR", "frames": frames}
    write.json(folder / "transforms.json", content)
    return content


def by_face(capture: Capture, photo: int = 0) -> dict:
    return {name: next(v for v in capture.views if v.name == f"{photo}/{name}") for name in FACES}


def moved(camera: Camera, part: tuple[float, float]) -> Camera:
    """The camera whose rays go through another part of each pixel than its centre."""
    return replace(camera, cx=camera.cx + 0.5 - part[0], cy=camera.cy + 0.5 - part[1])


@pytest.mark.parametrize("max_side", [None, 100])
def test_faces_are_what_pinhole_cameras_would_have_seen(tmp_path: Path, write, max_side: int | None) -> None:
    light = world()
    in_place(tmp_path, write, panorama(light))
    capture = load_capture(tmp_path, LoadSettings(max_side=max_side))
    for name, view in by_face(capture).items():
        camera = view.camera
        assert camera.width == camera.height == (max_side or round(SIZE[0] / np.pi))
        direct = np.mean([seen(light, moved(camera, part).exact_rays()) for part in PARTS], axis=0)
        psnr = -10 * np.log10(np.mean((view.read() - direct) ** 2))
        assert psnr > LEAST_PSNR, name


def test_the_front_face_has_the_pose_of_the_photo_and_the_others_look_where_they_say(
    tmp_path: Path, write
) -> None:
    in_place(tmp_path, write, panorama(world(), (64, 32)))
    faces = by_face(load_capture(tmp_path), photo=2)
    assert np.allclose([face.camera.position for face in faces.values()], (2, 0, 0), atol=1e-6)
    looks = {"front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1), "left": (-1, 0, 0)}
    for name, forward in {**looks, "up": (0, -1, 0), "down": (0, 1, 0)}.items():
        assert np.allclose(faces[name].camera.forward, forward, atol=1e-6)
        if name in looks:
            assert np.allclose(faces[name].camera.up, (0, -1, 0), atol=1e-6)


def test_masks_are_cut_alike(tmp_path: Path, write) -> None:
    size = (256, 128)
    in_place(tmp_path, write, panorama(world(), size))
    right = directions(size)[..., 0] > 0.3
    for index in range(3):
        write.save(tmp_path / "masks" / f"{index}.png", np.where(right, 0, 255).astype(np.uint8))
    for settings, field in ((LoadSettings(), "valid"), (LoadSettings(masks="subject"), "mask")):
        for view in by_face(load_capture(tmp_path, settings)).values():
            x = view.camera.rays()[..., 0]
            inside = np.abs(x - 0.3) > 0.04
            assert np.array_equal(view.read(field)[inside] > 0.5, x[inside] < 0.3)
            assert inside.mean() > 0.8


def test_alpha_is_the_mask_of_every_face(tmp_path: Path, write) -> None:
    size = (128, 64)
    alpha = np.where(directions(size)[..., 1] > 0, 255, 0).astype(np.uint8)
    in_place(tmp_path, write, np.dstack([panorama(world(), size), alpha]))
    faces = by_face(load_capture(tmp_path))
    assert faces["down"].read("mask").min() == 1
    assert faces["up"].read("mask").max() == 0
    assert faces["left"].read("mask")[:18].max() == 0
    assert faces["left"].read("mask")[22:].min() == 1


@pytest.mark.parametrize("suffix", ["npy", "png"])
def test_depth_is_distance_from_the_camera_in_every_face(tmp_path: Path, write, suffix: str) -> None:
    """A room of four metres, in a depth map smaller than the photo, as laser scanners write them."""
    in_place(tmp_path, write, panorama(world(), (256, 128)), depth_file_path=f"depth/{{}}.{suffix}")
    distance = 2 / np.abs(directions((512, 256))).max(-1)
    for index in range(3):
        path = tmp_path / "depth" / f"{index}.{suffix}"
        path.parent.mkdir(exist_ok=True)
        if suffix == "npy":
            np.save(path, 1000 * distance)
        else:
            write.save(path, np.round(1000 * distance).astype(np.uint16))
    for view in by_face(load_capture(tmp_path, LoadSettings(max_side=64))).values():
        points = view.read("depth")[..., None] * view.camera.rays()
        assert np.abs(np.abs(points).max(-1) - 2).max() < 0.03
        assert np.abs(np.abs(points).max(-1) - 2).mean() < 0.01


def test_depth_of_another_shape_is_refused(tmp_path: Path, write) -> None:
    in_place(tmp_path, write, panorama(world(), (64, 32)), depth_file_path="depth/{}.npy")
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth" / "0.npy", np.ones((24, 32)))
    with pytest.raises(TronError, match="depth has 32 x 24 pixels, its photo 2 x 1"):
        by_face(load_capture(tmp_path))["front"].read("depth")


def test_the_sky_is_found_in_the_whole_photo_and_cut(tmp_path: Path, write) -> None:
    """A face that looks down has an upper edge too, but no sky lies there."""
    down = directions((256, 128))[..., 1, None]
    picture = np.where(down < 0, (120, 170, 250), (90, 150, 240)) * np.where(np.abs(down) < 0.02, 0.2, 1)
    in_place(tmp_path, write, picture.astype(np.uint8))
    faces = by_face(load_capture(tmp_path, LoadSettings(sky=True)))
    assert faces["up"].read("sky_mask").min() == 1
    assert faces["down"].read("sky_mask").max() == 0
    assert faces["front"].read("sky_mask")[:36].min() == 1
    assert faces["front"].read("sky_mask")[45:].max() == 0
    assert np.array_equal(faces["front"].read("mask"), 1 - faces["front"].read("sky_mask"))


def test_photos_are_held_out_and_not_faces(tmp_path: Path, write) -> None:
    content = in_place(tmp_path, write, panorama(world(), (64, 32)), count=7)
    capture = load_capture(tmp_path, LoadSettings(test_every=3))
    assert capture.test == {f"{photo}/{face}" for photo in (0, 3, 6) for face in FACES}
    named = {"train_filenames": ["images/0.png", "images/1.png"], "test_filenames": ["images/2.png"]}
    write.json(tmp_path / "transforms.json", {**content, **named})
    capture = load_capture(tmp_path)
    assert capture.test == {f"2/{face}" for face in FACES}
    assert len(capture.train_views) == 12
    assert len(capture.skipped) == 4


def test_one_decoding_serves_all_faces(tmp_path: Path, write) -> None:
    """What was cut with the first face is kept: the file is not needed again, unless nothing is kept."""
    in_place(tmp_path, write, panorama(world(), (64, 32)))
    kept, not_kept = (load_capture(tmp_path, LoadSettings(cache_bytes=size)) for size in (10**7, 0))
    for capture in (kept, not_kept):
        by_face(capture)["front"].read()
    (tmp_path / "images" / "0.png").unlink()
    for view in by_face(kept).values():
        view.read()
    with pytest.raises(TronError, match="No such file"):
        by_face(not_kept)["left"].read()


@pytest.mark.parametrize("size", [(96, 64), (64, 64), (66, 32)])
def test_a_photo_of_another_shape_is_no_panorama(tmp_path: Path, write, size: tuple[int, int]) -> None:
    in_place(tmp_path, write, np.zeros((size[1], size[0], 3), np.uint8))
    with pytest.raises(TronError, match=f"twice as wide as high, not {size[0]} x {size[1]}") as caught:
        load_capture(tmp_path)
    assert len(str(caught.value).splitlines()) == 1


def test_columns_may_be_odd_and_are_not_without_end() -> None:
    assert len(Panorama(4095, 2048).faces) == 6
    for size, line in (((0, 0), "twice as wide"), ((40_000, 20_000), "40000 columns")):
        with pytest.raises(TronError, match=line):
            Panorama(*size)


def test_photos_that_cannot_be_cut_are_one_line_each(tmp_path: Path, write) -> None:
    content = in_place(tmp_path, write, panorama(world(), (64, 32)), count=5)
    (tmp_path / "images" / "1.png").unlink()
    data = (tmp_path / "images" / "2.png").read_bytes()
    (tmp_path / "images" / "2.png").write_bytes(data[: len(data) // 2])
    content["frames"][3]["transform_matrix"][0][3] = float("nan")
    write.json(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path)
    assert {view.name.split("/")[0] for view in capture.views} == {"0", "4"}
    assert set(capture.skipped) == {"1", "2", "3"}
    assert capture.skipped["1"] == "image not found"
    assert "truncated" in capture.skipped["2"]
    assert "NaN" in capture.skipped["3"]

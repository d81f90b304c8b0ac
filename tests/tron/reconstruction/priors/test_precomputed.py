"""Folders of maps: the same in every layout, encoding and frame; bad folders say what is bad."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tron.cameras import opencv_to_opengl
from tron.captures import Capture
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.io.images import write_image
from tron.reconstruction.priors import FIELDS, Precomputed, apply_prior
from tron.seeds import generator

HEIGHT, WIDTH = 40, 48  # of plain views

NAMES = ("frame_0", "frame_1")
LAYOUTS = {
    "folders of fields": "basecolor/{view}.png",
    "folders of views": "{view}/basecolor.png",
    "dots": "{view}.basecolor.png",
    "dashes, as RGB<->X's examples": "{view}-albedo.png",
    "underscores": "{view}_base_color.png",
    "DiffusionRenderer, images": "{view}/0000.0000.basecolor.jpg",
    "EXR": "basecolor/{view}.exr",
    "deeper, with the photos' folder": "maps/basecolor/images/{view}.png",
}


def grey(view: str) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 0.25 if view == "frame_0" else 0.5)


def save(folder: Path, pattern: str, image: Any) -> None:
    for view in NAMES:
        path = folder / pattern.format(view=view)
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels: Any = image(view) if callable(image) else image
        write_image(path, pixels)


@pytest.mark.parametrize("pattern", LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_gives_the_same_linear_base_color(tmp_path: Path, pattern: str, plain) -> None:
    encode = (lambda x: x) if pattern.endswith("exr") else linear_to_srgb
    save(tmp_path, pattern, lambda view: encode(grey(view)))
    out = apply_prior(plain(), Precomputed(str(tmp_path)))
    for view in out.train_views:
        np.testing.assert_allclose(view.read("base_color"), grey(view.name), atol=5e-3)
        assert [field for field in FIELDS if view.has(field)] == ["base_color"]


def test_frames_that_are_only_numbered_are_matched_by_order(tmp_path: Path, plain) -> None:
    for i in range(3):
        image = np.full((HEIGHT, WIDTH, 3), linear_to_srgb(np.array(0.1 * (i + 1))))
        path = tmp_path / "clip" / f"0000.{i:04d}.basecolor.png"
        path.parent.mkdir(exist_ok=True)
        write_image(path, image)
    with pytest.raises(TronError, match="3 maps of other names"):
        apply_prior(plain(), Precomputed(str(tmp_path)))
    out = apply_prior(plain(), Precomputed(str(tmp_path), match="order"))
    for i, view in enumerate(out.train_views):
        np.testing.assert_allclose(view.read("base_color"), 0.1 * (i + 1), atol=5e-3)
    path.unlink()
    with pytest.raises(TronError, match="2 base_color maps for 3 views"):
        apply_prior(plain(), Precomputed(str(tmp_path), match="order"))


@pytest.mark.parametrize("suffix", ["png", "exr"])
@pytest.mark.parametrize("frame", ["camera_opengl", "camera_opencv", "world"])
def test_normals_of_any_frame_become_the_same_world_normals(
    tmp_path: Path, frame: str, suffix: str, plain
) -> None:
    capture = plain()
    rng = generator(7, "priors")
    world = rng.normal(size=(HEIGHT, WIDTH, 3))
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    (tmp_path / "normal").mkdir()
    for view in capture.train_views:
        # Axes of the camera as columns, by the library's own conversion of poses.
        pose = view.camera.camera_to_world
        axes = {"camera_opengl": opencv_to_opengl(pose)[:3, :3], "camera_opencv": pose[:3, :3]}
        local = world @ axes.get(frame, np.eye(3))
        stored = local if suffix == "exr" else (local + 1) / 2
        write_image(tmp_path / "normal" / f"{view.name}.{suffix}", stored, half=False)
    out = apply_prior(capture, Precomputed(str(tmp_path), normal_frame=frame))  # type: ignore[arg-type]
    for view in out.train_views:
        np.testing.assert_allclose(view.read("normal"), world, atol=0.01)


def test_a_surface_that_faces_the_viewer_faces_the_viewer(tmp_path: Path, plain) -> None:
    """The one fact that fixes the default's sign: blue in these tools' maps looks at the camera."""
    save(tmp_path, "normal/{view}.png", np.full((HEIGHT, WIDTH, 3), (0.5, 0.5, 1.0)))
    for view in apply_prior(plain(), Precomputed(str(tmp_path))).train_views:
        np.testing.assert_allclose(view.read("normal")[0, 0], -view.camera.forward, atol=0.01)
    save(tmp_path, "normal/{view}.png", np.full((HEIGHT, WIDTH, 3), (0.5, 1.0, 0.5)))
    for view in apply_prior(plain(), Precomputed(str(tmp_path))).train_views:
        np.testing.assert_allclose(view.read("normal")[0, 0], view.camera.up, atol=0.01)


def test_backgrounds_are_no_normals(tmp_path: Path, plain) -> None:
    image = np.full((HEIGHT, WIDTH, 3), (0.5, 0.5, 1.0))
    image[:10], image[10:20] = 0.0, 0.5
    save(tmp_path, "normal/{view}.png", image)
    normal = apply_prior(plain(), Precomputed(str(tmp_path))).train_views[0].read("normal")
    assert not normal[:20].any()
    np.testing.assert_allclose(np.linalg.norm(normal[20:], axis=-1), 1, atol=1e-5)


def test_larger_maps_are_averaged_and_their_normals_stay_unit(tmp_path: Path, plain) -> None:
    checks = np.indices((4 * HEIGHT, 4 * WIDTH)).sum(0) % 2
    tilted = np.where(checks[..., None], (0.6, 0.0, 0.8), (-0.6, 0.0, 0.8))
    save(tmp_path, "normal/{view}.png", (tilted + 1) / 2)
    save(tmp_path, "roughness/{view}.png", checks.astype(float))
    view = apply_prior(plain(), Precomputed(str(tmp_path), normal_frame="world")).train_views[0]
    np.testing.assert_allclose(view.read("roughness"), 0.5, atol=5e-3)
    np.testing.assert_allclose(view.read("normal"), np.broadcast_to([0, 0, 1], (HEIGHT, WIDTH, 3)), atol=0.01)


def test_irradiance_is_linear_times_its_scale(tmp_path: Path, plain) -> None:
    save(tmp_path, "irradiance/{view}.exr", np.full((HEIGHT, WIDTH, 3), 3 * np.pi))
    out = apply_prior(plain(), Precomputed(str(tmp_path), irradiance_scale=1 / np.pi))
    np.testing.assert_allclose(out.train_views[0].read("irradiance"), 3.0, rtol=1e-3)
    save(tmp_path, "irradiance/{view}.png", np.full((HEIGHT, WIDTH, 3), 0.5))
    for path in (tmp_path / "irradiance").glob("*.exr"):
        path.unlink()
    out = apply_prior(plain(), Precomputed(str(tmp_path), irradiance_space="linear"))
    np.testing.assert_allclose(out.train_views[0].read("irradiance"), 0.5, atol=5e-3)


def test_stretched_maps_need_a_word(tmp_path: Path, plain) -> None:
    save(tmp_path, "roughness/{view}.png", np.full((HEIGHT, 2 * WIDTH), 0.5))
    with pytest.raises(TronError, match="roughness map of 96 x 40 pixels does not fit the view's 48 x 40"):
        apply_prior(plain(), Precomputed(str(tmp_path))).train_views[0].read("roughness")
    out = apply_prior(plain(), Precomputed(str(tmp_path), stretched=True))
    np.testing.assert_allclose(out.train_views[0].read("roughness"), 0.5, atol=5e-3)


def test_missing_files_are_counted_and_bad_ones_named(tmp_path: Path, caplog, plain) -> None:
    (tmp_path / "metallic").mkdir()
    write_image(tmp_path / "metallic" / "frame_1.png", np.zeros((HEIGHT, WIDTH)))
    out = apply_prior(plain(), Precomputed(str(tmp_path)))
    assert [view.has("metallic") for view in out.train_views] == [False, True]
    assert "missing for 1 of 2 views" in caplog.text
    (tmp_path / "metallic" / "frame_1.png").write_bytes(b"\x89PNG\r\n\x1a\n nothing")
    with pytest.raises(TronError, match=r"frame_1\.png"):
        out.train_views[1].read("metallic")


def test_two_files_for_one_map_are_refused_and_exr_beats_png(tmp_path: Path, plain) -> None:
    save(tmp_path, "roughness/{view}.png", np.full((HEIGHT, WIDTH), 0.2))
    save(tmp_path, "roughness/{view}.exr", np.full((HEIGHT, WIDTH), 0.7))
    out = apply_prior(plain(), Precomputed(str(tmp_path)))
    np.testing.assert_allclose(out.train_views[0].read("roughness"), 0.7, atol=1e-3)
    save(tmp_path, "{view}.roughness.exr", np.full((HEIGHT, WIDTH), 0.7))
    with pytest.raises(TronError, match="two files are the roughness of view frame_0"):
        apply_prior(plain(), Precomputed(str(tmp_path)))


def test_views_in_folders_are_told_apart_by_their_whole_name(tmp_path: Path, plain) -> None:
    one, two, three = plain().views
    views = [
        type(one)(name, v.camera, v.image, "display") for name, v in (("a/0.png", one), ("b/0.png", two))
    ]
    capture = Capture((*views, three), test=frozenset({three.name}))
    for folder, value in (("a", 0.2), ("b", 0.8)):
        (tmp_path / "roughness" / folder).mkdir(parents=True)
        write_image(tmp_path / "roughness" / folder / "0.png", np.full((HEIGHT, WIDTH), value))
    out = apply_prior(capture, Precomputed(str(tmp_path)))
    for view, value in zip(out.train_views, (0.2, 0.8)):
        np.testing.assert_allclose(view.read("roughness"), value, atol=5e-3)


@pytest.mark.parametrize(
    "change",
    [{"color_space": "gamma"}, {"normal_frame": "blender"}, {"match": "size"}, {"irradiance_scale": 0}],
)
def test_wrong_options_are_refused(tmp_path: Path, change: dict) -> None:
    with pytest.raises((ValidationError, TronError), match=next(iter(change))):
        Precomputed(str(tmp_path), **change)


def test_a_missing_or_empty_folder_is_refused(tmp_path: Path, plain) -> None:
    with pytest.raises(TronError, match="folder of prior maps not found"):
        Precomputed(str(tmp_path / "none"))  # at once: photos may take minutes to load
    with pytest.raises(TronError, match="no maps for 2 views such as frame_0"):
        apply_prior(plain(), Precomputed(str(tmp_path)))

"""The open sky of an outdoor photo is found, and nothing else that is smooth, bright or high up."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.captures.photos.photo_views import open_sky
from tron.seeds import generator

HEIGHT, WIDTH = 120, 160


@pytest.fixture
def castle() -> tuple[np.ndarray, np.ndarray]:
    """A photo (H, W, 3), sky from blue to white over a house and gravel, and its sky (H, W) bool."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    skyline = np.where(np.abs(columns - 80) < 50, 40 + np.abs(columns - 80) // 3, 80)
    sky = rows < skyline
    share = (rows / HEIGHT)[..., None]
    image = (1 - share) * (0.35, 0.55, 0.85) + share * (0.95, 0.97, 1.0)
    stones = generator(0, "castle").uniform(0.2, 0.6, (HEIGHT, WIDTH, 1)) * (1.0, 0.9, 0.7)
    image = np.where(sky[..., None], image, stones)
    image[95:, 40:] = (0.95, 0.94, 0.92)  # gravel in the sun, as smooth and bright as the sky
    image[:20, :30] = 0.05  # leaves in the shade, smooth and high up
    sky[:20, :30] = False
    return np.clip(image, 0, 1).astype(np.float32), sky


def test_the_sky_is_found_up_to_the_skyline(castle) -> None:
    image, sky = castle
    found = open_sky(image)
    assert not (found & ~sky).any()
    assert (found & sky).sum() > 0.97 * sky.sum()


def test_what_does_not_reach_the_upper_edge_is_no_sky(castle) -> None:
    image, _ = castle
    image[0] = 0.05
    assert not open_sky(image).any()


def test_a_photo_full_of_texture_has_no_sky() -> None:
    assert not open_sky(generator(0, "texture").random((HEIGHT, WIDTH, 3)).astype(np.float32)).any()


def test_the_sky_is_background_where_that_is_asked_for(tmp_path: Path, photos, write, castle) -> None:
    image, _ = castle
    stored = np.round(255 * image).astype(np.uint8)
    write.photos(tmp_path / "images", photos)
    write.save(tmp_path / "images" / photos.names[2], _of_size(stored, write.size))
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    assert not any(view.has("sky_mask") or view.has("mask") for view in load_capture(tmp_path).views)
    view = load_capture(tmp_path, LoadSettings(sky=True)).views[2]
    sky = view.read("sky_mask")
    np.testing.assert_array_equal(sky > 0.5, open_sky(view.read()))
    assert 0.2 < sky.mean() < 0.7
    np.testing.assert_array_equal(view.read("mask"), 1 - sky)


def test_a_mask_of_the_subject_says_more_than_the_sky(tmp_path: Path, photos, write) -> None:
    write.photos(tmp_path / "images", photos, channels=4)
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    assert not any(view.has("sky_mask") for view in load_capture(tmp_path, LoadSettings(sky=True)).views)


def _of_size(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

"""Masks are found where nerfstudio, COLMAP and people put them, and mean what the settings say."""

import logging
from pathlib import Path

import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.captures.folder import write_capture
from tron.captures.masks import beside_reduced, find_mask, mask_values
from tron.captures.photos.photo_files import PhotoHeader
from tron.captures.photos.photo_views import mask_of
from tron.errors import TronError

PLACES = {
    "nerfstudio": "masks/photo_03.png",
    "COLMAP": "masks/photo_03.png.png",
    "COLMAP, of the capture": "masks/images/photo_03.png.png",
    "beside": "images/photo_03_mask.png",
    "named": "hidden/three.png",
}


@pytest.fixture
def folder(tmp_path: Path, photos, write) -> Path:
    """A capture of ten photos."""
    write.photos(tmp_path / "images", photos)
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    return tmp_path


def half(write, white: int = 255) -> np.ndarray:
    """A mask whose left half is black."""
    width, height = write.size
    mask = np.zeros((height, width), np.uint8)
    mask[:, width // 2 :] = white
    return mask


@pytest.mark.parametrize("white", [1, 255])
@pytest.mark.parametrize("place", PLACES)
def test_a_mask_says_which_pixels_are_believed(folder: Path, photos, write, place: str, white: int) -> None:
    write.save(folder / PLACES[place], half(write, white))
    if place == "named":
        content = write.transforms(photos)
        content["frames"][3]["mask_path"] = PLACES[place]
        write.json(folder / "transforms.json", content)
    views = load_capture(folder).views
    assert len(views) == 10  # a mask is no photo
    assert [view.name for view in views if view.has("valid")] == ["photo_03"]
    believed = views[3].believed()
    assert not believed[:, : write.size[0] // 2].any()
    assert believed[:, write.size[0] // 2 :].all()
    assert views[2].believed().all()
    assert not views[3].has("mask")


def test_masks_have_any_depth_and_their_alpha_says_nothing() -> None:
    deep = np.array([[0, 255, 0x7FFF, 0x8000, 0xFFFF]], np.uint16)[..., None]
    assert mask_values(deep, "ignore")[0, :, 0].tolist() == [0, 0, 0, 255, 255]
    assert mask_values(deep, "subject")[0, :, 0].tolist() == [0, 0, 127, 128, 255]
    black_and_white = np.array([[[0, 0, 0, 255], [255, 255, 255, 255], [0, 200, 0, 0]]], np.uint8)
    assert mask_values(black_and_white, "ignore")[0, :, 0].tolist() == [0, 255, 255]


def test_the_mask_of_a_turned_photo_is_one_of_what_it_shows(tmp_path: Path, write) -> None:
    """A phone stores a portrait on its side, 96 x 72 pixels with EXIF's 6; its mask stands: 72 x 96."""
    width, height = 96, 72
    header = PhotoHeader(width, height, orientation=6)
    write.save(tmp_path / "a_mask.png", np.full((width, height), 255, np.uint8))
    found = mask_of(tmp_path / "a.png", header, "ignore", upright=True)
    assert found is not None
    assert found[1].size(upright=True) == (height, width)
    with pytest.raises(TronError, match="mask has 72 x 96 pixels, the photo 96 x 72"):
        mask_of(tmp_path / "a.png", header, "ignore", upright=False)


def test_a_mask_may_be_the_subject_instead(folder: Path, write, caplog) -> None:
    write.save(folder / "images" / "photo_03_mask.png", half(write))
    caplog.set_level(logging.INFO)
    view = load_capture(folder, LoadSettings(masks="subject")).views[3]
    assert not view.has("valid")
    np.testing.assert_array_equal(view.read("mask"), half(write) / 255)
    assert "masks of 1 photos is empty background" in caplog.text


def test_masks_are_passed_over_where_that_is_asked_for(folder: Path, write) -> None:
    write.save(folder / "images" / "photo_03_mask.png", half(write))
    view = load_capture(folder, LoadSettings(masks=None)).views[3]
    assert not view.has("valid")
    assert not view.has("mask")


def test_a_pixel_of_which_a_part_is_masked_is_not_believed(folder: Path, write) -> None:
    mask = np.full(write.size[::-1], 255, np.uint8)
    mask[5, 7] = 0
    write.save(folder / "masks" / "photo_03.png", mask)
    believed = load_capture(folder, LoadSettings(downscale=4)).views[3].believed()
    assert (~believed).sum() == 1
    assert not believed[1, 1]


def test_reduced_photos_take_reduced_masks(tmp_path: Path, write) -> None:
    for name in ("images_4/a.png", "masks_4/a.png", "masks/a.png"):
        write.save(tmp_path / name, half(write))
    photo, whole = tmp_path / "images_4" / "a.png", tmp_path / "masks" / "a.png"
    assert find_mask(photo) == tmp_path / "masks_4" / "a.png"
    # A mask that a file of poses names is that of the whole photo.
    assert beside_reduced(photo, whole) == tmp_path / "masks_4" / "a.png"
    assert beside_reduced(tmp_path / "images" / "a.png", whole) == whole
    assert beside_reduced(photo, tmp_path / "masks" / "b.png") == tmp_path / "masks" / "b.png"


def test_a_mask_of_another_size_costs_its_photo_and_is_named(folder: Path, write) -> None:
    write.save(folder / "masks" / "photo_03.png", half(write)[::2, ::2])
    capture = load_capture(folder)
    width, height = write.size
    assert capture.skipped == {
        "photo_03": f"mask has {width // 2} x {height // 2} pixels, the photo {width} x {height}"
    }


def test_masks_of_another_size_alone_are_one_line(folder: Path, photos, write) -> None:
    for name in photos.names:
        write.save(folder / "masks" / name, half(write)[::2, ::2])
    with pytest.raises(TronError, match=r"0 of 10 photos can be used, .*; mask has ") as caught:
        load_capture(folder)
    assert "\n" not in str(caught.value)


def test_alpha_and_a_mask_cannot_both_say_what_the_subject_is(folder: Path, write) -> None:
    write.save(folder / "images" / "photo_03.png", write.picture(3, channels=4))
    write.save(folder / "masks" / "photo_03.png", half(write))
    for settings in (LoadSettings(), LoadSettings(masks="subject")):
        (reason,) = load_capture(folder, settings).skipped.values()
        assert "alpha and a mask" in reason
        assert "masks=null" in reason
    assert not load_capture(folder, LoadSettings(masks=None)).skipped


def test_a_mask_that_is_named_and_absent_costs_its_photo(folder: Path, photos, write) -> None:
    content = write.transforms(photos)
    content["frames"][3]["mask_path"] = "masks/gone.png"
    write.json(folder / "transforms.json", content)
    assert load_capture(folder).skipped == {"photo_03": "mask not found"}
    content["frames"][3]["mask_path"] = "../elsewhere.png"
    write.json(folder / "transforms.json", content)
    with pytest.raises(TronError, match="leads out"):
        load_capture(folder)


def test_what_is_believed_survives_a_capture_folder(folder: Path, write, tmp_path: Path) -> None:
    write.save(folder / "masks" / "photo_03.png", half(write))
    capture = load_capture(folder)
    write_capture(tmp_path / "copy", capture)
    np.testing.assert_array_equal(
        load_capture(tmp_path / "copy").views[3].believed(), capture.views[3].believed()
    )


def test_features_are_not_sought_under_masks(tmp_path: Path, write) -> None:
    from PIL import Image

    from tron.captures.photos.photo_files import inspect_photo
    from tron.captures.posing.structure_from_motion import _copy, _copy_masks

    paths = [tmp_path / f"{name}.png" for name in "ab"]
    for path in paths:
        write.save(path, write.picture(0))
    write.save(tmp_path / "b_mask.png", half(write))
    copies = _copy({path: inspect_photo(path) for path in paths}, tmp_path / "work" / "images", 40)
    mask = find_mask(paths[1])
    assert mask is not None
    _copy_masks({photo: copy for copy, photo in copies.items()}, {paths[1]: mask}, tmp_path / "work")
    for copy, photo in copies.items():
        with Image.open(tmp_path / "work" / "masks" / f"{copy}.png") as stored:
            values = np.asarray(stored)
        assert max(values.shape) == 40
        assert values.all() == (photo == "a.png")
        assert values.any()

"""Folders of COLMAP and of tools around it, as people have them: all photos are found, with their poses."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.captures import LoadSettings, load_capture
from tron.captures.posing.structure_from_motion import has_photos
from tron.errors import TronError

SIDE, FOCAL, COUNT = 16, 20.0, 5
NAMES = tuple(f"IMG_{index:04d}.jpg" for index in range(COUNT))
SPACED = tuple(f"Foto {index}  (Küche, alt).jpg" for index in range(COUNT))
RIG = tuple(f"{side}/{frame:04d}.jpg" for frame in range(3) for side in ("left", "right"))
APART = 0.25
"""Distance of the rig's two cameras, along x."""


def photos(folder: Path, names: Sequence[str] = NAMES) -> None:
    """Plain photos; blue is what tells the folder ``input``."""
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (SIDE, SIDE), (20 * index, 90, 250 if folder.name == "input" else 120)).save(
            folder / name
        )


def model(folder: Path, names: Sequence[str] = NAMES, binary: bool = False, end: str = "\n") -> None:
    """A sparse model; camera i stands at (i, 0, 0) and looks along z."""
    folder.mkdir(parents=True)
    lines = ["# Image list", *(f"{i + 1} 1 0 0 0 {-i} 0 0 1 {name}{end}" for i, name in enumerate(names))]
    write(folder / "cameras.txt", f"1 PINHOLE {SIDE} {SIDE} {FOCAL} {FOCAL} 8 8{end}")
    write(folder / "images.txt", end.join(lines) + end)
    write(folder / "points3D.txt", "")
    if binary:
        import pycolmap

        scene = pycolmap.Reconstruction(folder)
        for number, name in enumerate(names, 1):
            scene.images[number].name = name
        shutil.rmtree(folder)
        folder.mkdir()
        scene.write_binary(folder)


def write(path: Path, text: str) -> None:
    path.write_text(text, "utf-8", newline="")


def rig(folder: Path, binary: bool) -> None:
    """Two cameras on a bar, three times, with COLMAP's files of rigs and frames."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    kind = pycolmap.SensorType.CAMERA
    sensors = [pycolmap.sensor_t(type=kind, id=number) for number in (1, 2)]
    for number in (1, 2):
        camera = pycolmap.Camera(model="PINHOLE", width=SIDE, height=SIDE, params=[FOCAL, FOCAL, 8, 8])
        camera.camera_id = number
        scene.add_camera(camera)
    bar = pycolmap.Rig(rig_id=1)
    bar.add_ref_sensor(sensors[0])
    bar.add_sensor(sensors[1], pycolmap.Rigid3d(np.array([[1, 0, 0, -APART], [0, 1, 0, 0], [0, 0, 1, 0.0]])))
    scene.add_rig(bar)
    for place in range(3):
        frame = pycolmap.Frame(frame_id=place + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(np.array([[1, 0, 0, -place], [0, 1, 0, 0], [0, 0, 1, 0.0]]))
        numbers = [2 * place + side + 1 for side in range(2)]
        for sensor, number in zip(sensors, numbers):
            frame.add_data_id(pycolmap.data_t(sensor_id=sensor, id=number))
        scene.add_frame(frame)
        for sensor, number in zip(sensors, numbers):
            image = pycolmap.Image(name=RIG[number - 1], camera_id=sensor.id, image_id=number)
            image.frame_id = place + 1
            scene.add_image(image)
        scene.register_frame(place + 1)
    folder.mkdir(parents=True)
    (scene.write_binary if binary else scene.write_text)(folder)


def two_models(root: Path, binary: bool) -> None:
    photos(root / "images")
    model(root / "sparse/0", NAMES[:3], binary)
    model(root / "sparse/1", NAMES, binary)


def graphdeco(root: Path) -> None:
    """Where 3DGS' convert.py stopped before the photos were undistorted."""
    photos(root / "input")
    model(root / "distorted/sparse/0")


def graphdeco_small(root: Path) -> None:
    """Where it undistorted the first and smaller of two models."""
    photos(root / "input")
    photos(root / "images", NAMES[:2])
    model(root / "distorted/sparse/0", NAMES[:2])
    model(root / "distorted/sparse/1", NAMES)
    model(root / "sparse/0", NAMES[:2])


def graphdeco_done(root: Path) -> None:
    """Where all is there: photos without distortion are taken."""
    photos(root / "input")
    model(root / "distorted/sparse/0")
    photos(root / "images")
    model(root / "sparse/0")


def graphdeco_without_originals(root: Path) -> None:
    photos(root / "images", NAMES[:3])
    model(root / "sparse/0", NAMES[:3])
    model(root / "distorted/sparse/0", NAMES)  # its lenses are not those of what is in images


def beside(root: Path, names: Sequence[str] = NAMES) -> None:
    photos(root, names)
    model(root / "sparse/0", names)


def with_images(make: Callable[[Path], None], folder: str = "images") -> Callable[[Path], None]:
    def build(root: Path) -> None:
        photos(root / folder)
        make(root)

    return build


def numbered(root: Path) -> None:
    for number in range(11):
        model(root / f"sparse/{number}", NAMES[: 2 + (number > 9)])


def all_in_one(root: Path) -> None:
    model(root / "model")
    for file in (root / "model").iterdir():
        file.rename(root / file.name)


def of_names(names: Sequence[str], binary: bool = False) -> Callable[[Path], None]:
    def build(root: Path) -> None:
        photos(root / "images", names)
        model(root / "sparse/0", names, binary)

    return build


def of_rig(binary: bool) -> Callable[[Path], None]:
    def build(root: Path) -> None:
        photos(root / "images", RIG)
        rig(root / "sparse/0", binary)

    return build


CASES: dict[str, tuple[Callable[[Path], None], str, int, str]] = {
    # what makes the folder, what is given of it, photos that are found, the folder they are in
    "small model first, text": (lambda root: two_models(root, False), ".", COUNT, "images"),
    "small model first, binary": (lambda root: two_models(root, True), ".", COUNT, "images"),
    "its folder sparse": (lambda root: two_models(root, True), "sparse", COUNT, "images"),
    "tenth model": (with_images(numbered), ".", 3, "images"),
    "models beside photos": (with_images(lambda root: model(root / "1")), ".", COUNT, "images"),
    "model and photos in one folder": (with_images(all_in_one), ".", COUNT, "images"),
    "3DGS, not undistorted": (graphdeco, ".", COUNT, "input"),
    "3DGS, its folder distorted": (graphdeco, "distorted", COUNT, "input"),
    "3DGS, small model undistorted": (graphdeco_small, ".", COUNT, "input"),
    "3DGS, done": (graphdeco_done, ".", COUNT, "images"),
    "3DGS, originals gone": (graphdeco_without_originals, ".", 3, "images"),
    "input, sparse": (with_images(lambda root: model(root / "sparse/0"), "input"), ".", COUNT, "input"),
    "photos beside sparse": (beside, ".", COUNT, "."),
    "spaces, text": (of_names(SPACED), ".", COUNT, "images"),
    "spaces, binary": (of_names(SPACED, binary=True), ".", COUNT, "images"),
    "spaces, beside": (lambda root: beside(root, SPACED), ".", COUNT, "."),
    "lines of Windows": (
        with_images(lambda root: model(root / "sparse/0", end="\r\n")),
        ".",
        COUNT,
        "images",
    ),
    "rig, text": (of_rig(binary=False), ".", 6, "images"),
    "rig, binary": (of_rig(binary=True), ".", 6, "images"),
}


@pytest.mark.parametrize("case", CASES)
def test_every_photo_is_found_with_its_pose(tmp_path: Path, case: str) -> None:
    make, given, count, folder = CASES[case]
    make(tmp_path)
    capture = load_capture(tmp_path / given, LoadSettings(max_side=None))
    assert len(capture.views) == count
    if case.startswith("rig"):
        places = [place + APART * side for side in range(2) for place in range(3)]
    else:
        places = list(range(count))
    at = np.array([view.camera.position for view in capture.views])
    assert np.allclose(at, [(place, 0, 0) for place in places], atol=1e-6)
    photo = np.array(Image.open(min((tmp_path / folder).rglob("*.jpg"))))[0, 0]
    assert np.abs(255 * capture.views[0].read()[0, 0] - photo).max() < 1.01


def test_a_line_says_which_of_several_models_is_taken(tmp_path: Path, caplog) -> None:
    two_models(tmp_path, False)
    with caplog.at_level(logging.INFO, "tron"):
        load_capture(tmp_path)
    lines = [record.getMessage() for record in caplog.records if "model" in record.getMessage()]
    assert len(lines) == 1
    assert f"{tmp_path / 'sparse/1'} is taken" in lines[0]
    assert f"{tmp_path / 'sparse/0'} has 3" in lines[0]


def test_a_damaged_model_gives_way_to_a_whole_one(tmp_path: Path) -> None:
    two_models(tmp_path, True)
    with (tmp_path / "sparse/0/images.bin").open("r+b") as file:
        file.write((2**60).to_bytes(8, "little"))
    assert len(load_capture(tmp_path).views) == COUNT


def without_empty_lines(root: Path) -> None:
    photos(root / "images")
    model(root / "sparse/0")
    path = root / "sparse/0/images.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if line))


def latin_1(root: Path) -> None:
    photos(root / "images")
    model(root / "sparse/0", binary=True)
    path = root / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"IMG_0000", b"IMG_\xe4000"))


@pytest.mark.parametrize(
    ("make", "said"),
    [(without_empty_lines, "each image has two lines"), (latin_1, "image names are not UTF-8")],
)
def test_what_colmap_would_misread_is_one_line(
    tmp_path: Path, make: Callable[[Path], None], said: str
) -> None:
    make(tmp_path)
    with pytest.raises(TronError, match=said) as caught:
        load_capture(tmp_path)
    assert str(tmp_path / "sparse/0") in str(caught.value)


def test_photos_of_3dgs_are_posed_where_no_model_is(tmp_path: Path) -> None:
    photos(tmp_path / "input")
    assert has_photos(tmp_path)


def test_the_capture_that_was_reported(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "field" / "two-models"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    shutil.copytree(folder / "sparse", tmp_path / "sparse")
    os.symlink(shared_data / "field" / "georeferenced-capture" / "images", tmp_path / "images")
    assert len(load_capture(tmp_path).views) == 24

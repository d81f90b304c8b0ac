"""Photos and videos of 360 degrees and fisheyes without poses: posed as what they are, or one line."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from tron.captures import load_capture
from tron.captures.photos.photo_files import inspect_photo
from tron.captures.posing import video
from tron.captures.posing.structure_from_motion import pose_photos
from tron.captures.posing.wide_pictures import equirectangular, refuse_discs, refuse_video
from tron.errors import TronError
from tron.lenses import Lens, impossible
from tron.seeds import generator

HEIGHT = 64
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)


def world(directions: np.ndarray, phase: float) -> np.ndarray:
    """A smooth world of many waves, (..., 3) levels in [0, 255]."""
    rng = generator(0, "test", "wide")
    waves = rng.normal(size=(24, 3)) * 6
    values = np.sin(directions @ waves.T + phase + np.arange(24))
    return 127.5 + 60 * np.stack([values[..., k::3].sum(-1) / 4 for k in range(3)], -1)


def all_around(phase: float, height: int = HEIGHT) -> np.ndarray:
    """An equirectangular picture of it."""
    longitude = (np.arange(2 * height) + 0.5) / height * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    lon, lat = np.meshgrid(longitude, latitude)
    directions = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
    return world(directions, phase).clip(0, 255).astype(np.uint8)


def flat(phase: float) -> np.ndarray:
    """A pinhole's picture of it, twice as wide as high, as phones of 18:9 take them."""
    x, y = np.meshgrid(np.linspace(-1, 1, 2 * HEIGHT), np.linspace(-0.5, 0.5, HEIGHT))
    directions = np.stack([x, y, np.ones_like(x)], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return world(directions, phase).clip(0, 255).astype(np.uint8)


def disc(phase: float, side: int = HEIGHT) -> np.ndarray:
    """A fisheye's circle in black."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    inside = np.hypot(x, y) < 0.98
    directions = np.stack([x, y, np.sqrt(np.maximum(0, 1 - x * x - y * y))], -1)
    return (world(directions, phase).clip(30, 255) * inside[..., None]).astype(np.uint8)


def on_black(phase: float) -> np.ndarray:
    """A thing on black, which turns: no disc."""
    picture = disc(phase)
    picture[:, : HEIGHT // 4] = 0
    picture[: int(20 + 10 * np.sin(phase))] = 0
    return picture


def photos(folder: Path, make, count: int = 4, xmp: str | None = None) -> Path:
    folder.mkdir()
    for k in range(count):
        told = b"" if xmp is None else XMP.format(xmp).encode()
        Image.fromarray(make(k * 0.7)).save(folder / f"{k}.jpg", quality=92, xmp=told)
    return folder


def around(folder: Path) -> int:
    headers = {path: inspect_photo(path) for path in sorted(folder.iterdir())}
    return len(equirectangular(headers, Image.open))


def test_photos_of_360_degrees_are_told_by_what_they_show(tmp_path: Path) -> None:
    assert around(photos(tmp_path / "around", all_around)) == 4
    assert around(photos(tmp_path / "flat", flat)) == 0
    assert around(photos(tmp_path / "square", disc)) == 0


@pytest.mark.parametrize(
    ("xmp", "what"),
    [
        ('GPano:ProjectionType="equirectangular"', 4),
        ('GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="128" '
         'GPano:CroppedAreaImageWidthPixels="128"', 4),
        ('GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="128" '
         'GPano:CroppedAreaImageWidthPixels="90"', "a part of the sphere"),
        ('GPano:ProjectionType="cylindrical"', "in the projection cylindrical"),
    ],
)  # fmt: skip
def test_photos_are_taken_at_their_word(tmp_path: Path, xmp: str, what: int | str) -> None:
    """Whatever they show."""
    folder = photos(tmp_path / "a", flat, xmp=xmp)
    if isinstance(what, int):
        assert around(folder) == what
    else:
        with pytest.raises(TronError, match=what):
            around(folder)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (disc, "circular fisheyes"),
        (lambda phase: np.hstack([disc(phase), disc(phase + 3)]), "two fisheye pictures.*stitch"),
        (on_black, None),
        (all_around, None),
        (flat, None),
        (lambda phase: flat(phase) // 16, None),
    ],
)
def test_discs_in_black_are_one_line(tmp_path: Path, make, words: str | None) -> None:
    paths = sorted(photos(tmp_path / "a", make).iterdir())
    if words is None:
        refuse_discs(paths, Image.open)
    else:
        with pytest.raises(TronError, match=words):
            pose_photos(tmp_path / "a", video.VideoSettings())


@pytest.mark.parametrize("name", ["a.insv", "a.insp", "a.360"])
def test_raw_files_of_360_cameras_are_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    Image.fromarray(np.hstack([disc(0), disc(3)])).save(path, format="jpeg")
    for given in (path, tmp_path):
        with pytest.raises(TronError, match=r"raw 360 format.*stitch it to equirectangular"):
            load_capture(given)


def film(path: Path, streams: int, sizes: tuple[int, ...] = (HEIGHT, HEIGHT)) -> Path:
    with av.open(str(path), "w") as container:
        made = []
        for k in range(streams):
            stream = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height, stream.pix_fmt = sizes[k], HEIGHT, "yuv420p"
            made.append(stream)
        for frame in range(4):
            for k, stream in enumerate(made):
                pixels = np.full((HEIGHT, sizes[k], 3), 60 * frame, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels)))
        for stream in made:
            container.mux(stream.encode())
    return path


def test_a_stream_a_lens_is_one_line(tmp_path: Path) -> None:
    refuse_video(film(tmp_path / "one.mp4", 1))
    refuse_video(film(tmp_path / "two.mp4", 2, (HEIGHT, 2 * HEIGHT)))  # a phone's, with depth
    with pytest.raises(TronError, match=r"two streams of one size.*stitch"):
        load_capture(film(tmp_path / "raw.mp4", 2))


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (b"st3d\0\0\0\0\1", "two eyes"),
        (b"st3d\0\0\0\0\0", None),
        (b"<GSpherical:StereoMode>top-bottom</GSpherical:StereoMode>", "two eyes"),
        (b"<GSpherical:StereoMode>mono</GSpherical:StereoMode>", None),
        (b"sv3d" + bytes(40) + b"cbmp", "a cube map"),
        (b"sv3d" + bytes(40) + b"equi", None),
    ],
)
def test_spherical_metadata_that_cannot_be_followed_are_one_line(
    tmp_path: Path, told: bytes, words: str | None
) -> None:
    """A box that is appended to moov, which stands last."""
    path = film(tmp_path / "a.mp4", 1)
    data = bytearray(path.read_bytes())
    at = data.rfind(b"moov") - 4
    box = struct.pack(">I4s", len(told) + 8, b"free") + told
    data[at : at + 4] = struct.pack(">I", len(data) - at + len(box))
    path.write_bytes(bytes(data + box))
    if words is None:
        refuse_video(path)
    else:
        with pytest.raises(TronError, match=words):
            refuse_video(path)


def test_lenses_that_nobody_has_are_never_right(tmp_path: Path) -> None:
    assert impossible(Lens("OPENCV", 768, 384, (168, 10801, 384, 192, 0, 0, 0, 0)))
    assert impossible(Lens("SIMPLE_PINHOLE", 768, 384, (130, 384, 192)))
    assert impossible(Lens("PINHOLE", 384, 768, (400, 460, 384, 192)))
    for lens in (
        Lens("OPENCV", 768, 384, (400, 420, 384, 192, 0, 0, 0, 0)),
        Lens("OPENCV_FISHEYE", 768, 768, (240, 240, 384, 384, 0, 0, 0, 0)),
        Lens("SIMPLE_RADIAL", 768, 384, (300, 384, 192, 0.1)),
    ):
        assert impossible(lens) is None
    for k in range(3):
        Image.new("RGB", (768, 384)).save(tmp_path / f"{k}.jpg")
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 768 384 168 10801 384 192 0 0 0 0\n")
    (model / "images.txt").write_text("".join(f"{k + 1} 1 0 0 0 {k} 0 0 1 {k}.jpg\n\n" for k in range(3)))
    (model / "points3D.txt").touch()
    with pytest.raises(TronError, match=r"168 and 10801 pixels, which no camera has: is it a photo of 360"):
        load_capture(tmp_path)


def off_the_ring(capture) -> float:
    """Largest distance of the twelve places from where they were, over the ring's radius.

    They turn by 0.45 radians from photo to photo and rise and fall by 0.275 sin 0.9 k.
    """
    k = np.arange(12)
    truth = np.stack([np.cos(0.45 * k), 0.275 * np.sin(0.9 * k), np.sin(0.45 * k)], 1)
    places = np.array([view.camera.position for view in capture.views[::6]])
    a, b = places - places.mean(0), truth - truth.mean(0)
    left, sizes, right = np.linalg.svd(a.T @ b)
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = (sizes * signs).sum() / (a * a).sum()
    return float(np.linalg.norm(scale * a @ (left * signs @ right) - b, axis=1).max())


@pytest.mark.long
def test_photos_of_360_degrees_without_poses_become_six_views_each(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "field" / "panorama-bare"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    shutil.copytree(folder, tmp_path / "photos")
    capture = load_capture(tmp_path / "photos")
    assert len(capture.views) == 72
    assert off_the_ring(capture) < 0.02


@pytest.mark.long
def test_a_video_of_360_degrees_becomes_six_views_a_frame(shared_data: Path, tmp_path: Path) -> None:
    """Frames say nothing of themselves: what they show tells."""
    folder = shared_data / "field" / "panorama-bare"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    with av.open(str(tmp_path / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=2, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = 768, 384, "yuv420p"
        for path in sorted(folder.glob("*.jpg")):
            container.mux(stream.encode(av.VideoFrame.from_image(Image.open(path))))
        container.mux(stream.encode())
    capture = load_capture(tmp_path / "walk.mp4")
    assert len(capture.views) == 72
    assert off_the_ring(capture) < 0.03


def test_the_raw_video_of_the_field(shared_data: Path, tmp_path: Path) -> None:
    """By its name, and by what it shows under another."""
    path = shared_data / "field" / "dual-fisheye" / "p_dual.insv"
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    with pytest.raises(TronError, match=r"Insta360's raw 360 format.*stitch"):
        load_capture(path)
    shutil.copy(path, tmp_path / "walk.mp4")
    with pytest.raises(TronError, match=r"two fisheye pictures side by side.*stitch"):
        load_capture(tmp_path / "walk.mp4")

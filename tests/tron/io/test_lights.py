"""Light in every form it is found in comes back as the light it was painted from."""

import struct
import zlib
from pathlib import Path

import numpy as np
import py360convert
import pytest

from tron.apps.environment import Settings, main
from tron.errors import TronError
from tron.io.cube_files import open_cube
from tron.io.image_headers import jpeg_xl_size
from tron.io.images import encode_png, read_image, write_image
from tron.io.lat_long import directions
from tron.io.lights import lat_long_of_ball, lat_long_of_cube, read_light
from tron.shading.environments.environment import EnvironmentMap

imagecodecs = pytest.importorskip("imagecodecs", reason="pip install 'tron-relight[lights]'")

SIDE = 32
ORDER = "RLUDFB"
"""Our +x, -x, +y, -y, +z, -z in py360convert's letters, whose front is the middle of its lat-long picture."""


def radiance(d: np.ndarray) -> np.ndarray:
    """Smooth, of all signs, different along every axis: (..., 3) in our world's frame."""
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([2 + x + 0.5 * z * y, 1.5 + y, 1.5 + z + 0.3 * x * y], axis=-1)


def lat_long(height: int = 2 * SIDE) -> np.ndarray:
    return radiance(directions(height, 2 * height)).astype(np.float32)


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    """Six faces that another library has cut from a lat-long picture, seen from inside, upright."""
    centres = (np.arange(256) + 0.5) / 256 * np.pi  # its rows do not stand on the poles
    around = (np.arange(512) + 0.5)[None] * np.pi / 256
    across = np.sin(centres)[:, None]
    d = np.stack(
        [across * np.sin(around), across * np.cos(around), np.cos(centres)[:, None] + 0 * around], -1
    )
    cut = py360convert.e2c(radiance(d), face_w=SIDE, mode="bilinear", cube_format="dict")
    return np.stack([cut[letter] for letter in ORDER]).astype(np.float32)


def cross(faces: np.ndarray, upright: bool) -> np.ndarray:
    right, left, up, down, front, back = faces
    none = np.zeros_like(front)
    if upright:
        rows = [[none, up, none], [left, front, right], [none, down, none], [none, back[::-1, ::-1], none]]
    else:
        rows = [[none, up, none, none], [left, front, right, back], [none, down, none, none]]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def test_the_cross_of_another_library_is_ours(faces):
    dice = py360convert.cube_h2dice(py360convert.cube_dict2h(dict(zip(ORDER, faces))))
    np.testing.assert_array_equal(dice, cross(faces, upright=False))


def written(folder: Path, form: str, faces: np.ndarray) -> Path:
    if form == "six faces":
        for name, face in zip(("px", "nx", "py", "ny", "pz", "nz"), faces):
            write_image(folder / f"sky_{name}.exr", face, half=False)
        return folder
    rgba = np.concatenate([faces, np.ones_like(faces[..., :1])], axis=-1)
    if form == "dds":
        return _saved(folder / "a.dds", dds(rgba.astype(np.float16).tobytes(), 10))
    if form == "ktx2":
        return _saved(folder / "a.ktx2", ktx2(rgba.astype(np.float32).tobytes(), 109))
    picture = {
        "cross": cross(faces, False), "upright cross": cross(faces, True),
        "strip": np.concatenate(faces, axis=1), "upright strip": np.concatenate(faces),
    }[form]  # fmt: skip
    write_image(folder / "a.exr", picture, half=False)
    return folder / "a.exr"


def _saved(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def dds(payload: bytes, number: int, side: int = SIDE) -> bytes:
    """DDS_HEADER and DDS_HEADER_DXT10 of a cube map of one level."""
    header = struct.pack("<4s7I44x", b"DDS ", 124, 0x1007, side, side, 0, 0, 1)
    pixels = struct.pack("<2I4s5I", 32, 4, b"DX10", 0, 0, 0, 0, 0)
    caps = struct.pack("<5I", 0x1008, 0xFE00, 0, 0, 0)
    return header + pixels + caps + struct.pack("<5I", number, 3, 4, 1, 0) + payload


def ktx2(payload: bytes, number: int, scheme: int = 0, side: int = SIDE) -> bytes:
    """Header, index and one level of KTX 2.0, without a data format descriptor."""
    stored = {0: payload, 2: imagecodecs.zstd_encode(payload), 3: zlib.compress(payload)}[scheme]
    header = struct.pack("<9I4I2Q", number, 4, side, side, 0, 0, 6, 1, scheme, *(0,) * 6)
    index = struct.pack("<3Q", 104, len(stored), len(payload))
    return b"\xabKTX 20\xbb\r\n\x1a\n" + header + index + stored


@pytest.mark.parametrize(
    "form", ["cross", "upright cross", "strip", "upright strip", "six faces", "dds", "ktx2"]
)
def test_cube_maps_are_the_light_they_were_cut_from(tmp_path: Path, faces, form: str):
    found = EnvironmentMap.load(written(tmp_path, form, faces)).image
    assert found.shape == (2 * SIDE, 4 * SIDE, 3)
    assert np.abs(found - lat_long()).max() < 0.02


def test_edges_of_faces_are_seamless(faces):
    """A face that is clamped at its edges is flat there for half a texel on both sides."""
    found = lat_long_of_cube(faces)
    step = np.abs(np.diff(found[SIDE], axis=0)).max()
    assert step < 1.3 * np.abs(np.diff(lat_long()[SIDE], axis=0)).max()


@pytest.mark.parametrize("scheme", [0, 2, 3])
def test_ktx2_in_all_its_compressions(faces, scheme: int):
    data = ktx2(faces.astype(np.float32).tobytes(), 106, scheme)
    np.testing.assert_array_equal(open_cube(data)[0], faces)
    with pytest.raises(TronError, match="cut short"):
        open_cube(data[:-200])


def test_block_compressed_half_floats_are_read():
    """BC6H in mode 11: two endpoints of 10 bits a channel, of which all texels take the first."""
    first = 300
    block = 0b00011 | first << 5 | first << 15 | first << 25 | 7 << 35 | 9 << 45 | 11 << 55
    half = (((first << 15) + 0x4000) >> 9) * 31 >> 6
    wanted = np.array(half, np.uint16).view(np.float16)
    found, display = open_cube(dds(block.to_bytes(16, "little") * 24, 95, 8))
    assert found.shape == (6, 8, 8, 3)
    assert not display
    np.testing.assert_allclose(found, float(wanted))


@pytest.mark.parametrize("number, word, wanted", [
    (26, 15 << 6 | 1 << 5 | (16 << 6) << 11 | (14 << 5) << 22, (1.5, 2.0, 0.5)),
    (67, 256 | 128 << 9 | 64 << 18 | 17 << 27, (2.0, 1.0, 0.5)),
])  # fmt: skip
def test_packed_floats_are_read(number: int, word: int, wanted: tuple[float, ...]):
    """By hand from Direct3D's definitions: exponent 15 is 1 of R11G11B10; 256 / 512 at exponent 17 is 2."""
    found, _ = open_cube(dds(struct.pack("<I", word) * 24, number, 2))
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape))


def test_jpeg_xl_is_radiance(tmp_path: Path):
    data = imagecodecs.jpegxl_encode(lat_long(), lossless=True)
    assert jpeg_xl_size(data) == (4 * SIDE, 2 * SIDE)
    found = read_light(_saved(tmp_path / "a.jxl", data))
    np.testing.assert_allclose(found, lat_long(), rtol=1e-5)
    with pytest.raises(TronError, match="not a readable JPEG XL"):
        read_light(_saved(tmp_path / "b.jxl", data[:200]))


def test_a_gain_map_gives_back_what_a_jpeg_clips(tmp_path: Path):
    """A lamp of four times white; 4 % is what two JPEGs of 8 bits leave of it."""
    rgba = np.full((64, 128, 4), 0.5, np.float16)
    rgba[16:48, 32:64, :3], rgba[..., 3] = 4.0, 1
    found = read_light(_saved(tmp_path / "phone.jpg", imagecodecs.ultrahdr_encode(rgba)))
    assert np.median(found[24:40, 40:56]) == pytest.approx(4, rel=0.04)
    assert np.median(found[:, 96:]) == pytest.approx(0.5, rel=0.04)


@pytest.mark.parametrize("distance", [1.5, 100.0])
def test_a_mirror_ball_shows_what_a_ray_tracer_reflects_in_it(distance: float):
    """Rays of a pinhole, one a pixel, are reflected where they meet the unit sphere."""
    side = 512
    at = ((np.arange(side) + 0.5) / side * 2 - 1) / np.sqrt(distance**2 - 1)
    x, y = np.meshgrid(at, -at)
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = ray[..., 2] * distance
    root = along**2 - distance**2 + 1
    hit = np.array([0, 0, distance]) + ray * (-along - np.sqrt(np.maximum(root, 0)))[..., None]
    out = ray - 2 * (ray * hit).sum(-1, keepdims=True) * hit
    seen = np.where(
        (root > 0)[..., None], radiance(np.stack([-out[..., 0], out[..., 2], out[..., 1]], -1)), 0
    )
    found = lat_long_of_ball(seen.astype(np.float32), "mirror_ball", distance=distance, height=64)
    away = np.abs(found - lat_long(64)).max(-1)
    # Near the rim the ball shows what lies behind it, squeezed; what it hides is nowhere.
    behind = directions(64, 128)[..., 1] < 0.1 - np.sqrt(1 - 1 / distance**2)
    assert away[~behind].max() < 0.05


def test_an_angular_map_by_its_definition():
    """Debevec: the distance from the centre is the angle from the view, 180 degrees at the rim."""
    side = 512
    at = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(at, -at)
    angle, around = np.hypot(x, y) * np.pi, np.arctan2(y, x)
    right, up, ahead = np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)
    seen = radiance(np.stack([-right, -ahead, up], axis=-1))
    found = lat_long_of_ball(seen.astype(np.float32), "angular", height=64)
    assert np.abs(found - lat_long(64))[:, 8:-8].max() < 0.05


def test_a_square_picture_says_how_it_is_read(tmp_path: Path):
    write_image(tmp_path / "ball.exr", np.ones((64, 64, 3), np.float32))
    with pytest.raises(TronError, match=r"tron-environment environment=.*layout=mirror_ball"):
        EnvironmentMap.load(tmp_path / "ball.exr")


@pytest.mark.parametrize("name, data, words", [
    ("a.dds", dds(b"", 10), "cut short"),
    ("a.dds", dds(b"\0" * 512, 61, 4), "pixel format 61"),
    ("a.dds", dds(b"", 10, 60000), "too large"),
    ("a.ktx2", ktx2(b"", 97, side=60000), "too large"),
    ("a.ktx2", b"\xabKTX 20\xbb\r\n\x1a\n", "cut short"),
    ("a.jxl", b"\xff\x0a" + (3 << 1 | 2**30 - 1 << 3 | 1 << 33).to_bytes(12, "little"), "too large"),
    ("a.jpg", b"\xff\xd8\xff" + b"http://ns.adobe.com/hdr-gain-map/1.0/", "cannot identify|not a readable"),
])  # fmt: skip
def test_damage_and_bombs_are_one_line(tmp_path: Path, name: str, data: bytes, words: str):
    with pytest.raises(TronError, match=words):
        read_light(_saved(tmp_path / name, data))


def test_the_command_turns_measures_and_shows(tmp_path: Path, faces, caplog):
    caplog.set_level("INFO")
    image = lat_long(32)
    image[8, 16] = 5000  # a sun at u = 0.26, 47 degrees from the zenith
    write_image(tmp_path / "a.exr", image, half=False)
    out, shown = tmp_path / "b.exr", tmp_path / "b.png"
    given = {"environment": tmp_path / "a.exr", "output": out}
    main(Settings.model_validate(given | {"picture": shown, "rotation": 90}))
    np.testing.assert_allclose(read_image(out), np.roll(image, -16, axis=1), rtol=1e-6)
    assert "(high)" in caplog.text
    assert "brightest towards [" in caplog.text
    picture = read_image(shown)
    assert picture.shape == (768, 1024, 3)
    assert picture[600, 512:].max() > 0.2  # the white ball is lit
    with pytest.raises(TronError, match="unknown format"):
        main(Settings.model_validate(given | {"output": tmp_path / "b.jpg"}))


def test_png_faces_are_decoded(tmp_path: Path):
    for name in ("right", "left", "top", "bottom", "front", "back"):
        (tmp_path / f"{name}.png").write_bytes(encode_png(np.full((8, 8, 3), 0.5, np.float32)))
    assert read_light(tmp_path).mean() == pytest.approx(((0.5019608 + 0.055) / 1.055) ** 2.4, rel=1e-4)

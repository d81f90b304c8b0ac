"""Images: what is written is what is read, against independent readers."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tron.errors import TronError
from tron.io import images
from tron.seeds import generator


def picture(channels: int = 3, height: int = 13, width: int = 21) -> np.ndarray:
    return generator(0, "image", channels).random((height, width, channels)).astype(np.float32)


def radiance(channels: int = 3) -> np.ndarray:
    """Values over many orders of magnitude, as in a light probe."""
    return (10 ** (8 * picture(channels) - 4)).astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_in_full_precision_is_exact(tmp_path: Path, channels: int):
    image = radiance(channels)
    image[0, 0, 0], image[0, 1, 0] = np.inf, np.nan
    images.write_image(tmp_path / "a.exr", image, half=False)
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.exr", channels=None), image)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_in_half_rounds_to_half_and_saturates(channels: int):
    image = radiance(channels) * 100
    assert image.max() > 65504
    expected = np.minimum(image, 65504).astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(images.decode_exr(images.encode_exr(image)), expected)


def test_exr_bytes_are_deterministic():
    assert images.encode_exr(radiance()) == images.encode_exr(radiance())


def test_exr_and_hdr_agree_with_mitsubas_readers(variant: str, tmp_path: Path):
    import mitsuba as mi

    image = radiance()
    for name, half in (("a.exr", True), ("b.exr", False), ("c.hdr", False)):
        images.write_image(tmp_path / name, image, half)
        bitmap: Any = mi.Bitmap(str(tmp_path / name))
        witness = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
        np.testing.assert_allclose(images.read_image(tmp_path / name), witness, rtol=1e-6)


def test_mitsubas_files_are_read(variant: str, tmp_path: Path):
    import mitsuba as mi

    image = radiance()
    for name in ("a.exr", "b.hdr"):
        mi.Bitmap(image).write(str(tmp_path / name))
        # RGBE keeps 8 bits of the brightest channel.
        tolerance = 1e-6 if name == "a.exr" else image.max(axis=2, keepdims=True) / 128
        assert (np.abs(images.read_image(tmp_path / name) - image) <= tolerance).all()


def test_hdr_keeps_eight_bits_of_the_brightest_channel(tmp_path: Path):
    image = radiance()
    images.write_image(tmp_path / "a.hdr", image)
    error = np.abs(images.read_image(tmp_path / "a.hdr") - image) / image.max(axis=2, keepdims=True)
    assert error.max() < 1 / 127


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_exact_for_bytes_and_agrees_with_pillow(tmp_path: Path, channels: int):
    pixels = np.round(picture(channels) * 255).astype(np.uint8)
    images.write_image(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), pixels.squeeze())
    read = images.read_image(tmp_path / "a.png", channels=None)
    np.testing.assert_array_equal(np.round(read * 255), pixels)
    assert images.encode_png(read) == images.encode_png(pixels)  # float and byte input mean the same


def test_png_clips_to_the_display():
    image = np.array([[[-1.0, 0.5, 7.0]], [[np.nan, np.inf, -np.inf]]])
    read = images.decode_png(images.encode_png(image))
    np.testing.assert_allclose(read, [[[0, 128 / 255, 1]], [[0, 1, 0]]])


def test_png_of_sixteen_bits_keeps_its_precision():
    values = np.array([[0, 1, 256, 65535]], dtype=np.uint16)
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    np.testing.assert_allclose(images.decode_png(stream.getvalue())[..., 0], values / 65535, rtol=1e-6)


@pytest.mark.parametrize("mode, channels", [("1", 3), ("P", 3), ("LA", 4), ("L", 1), ("RGBA", 4)])
def test_png_modes_become_channels(mode: str, channels: int):
    stream = io.BytesIO()
    Image.fromarray(np.round(picture() * 255).astype(np.uint8)).convert(mode).save(stream, "PNG")
    assert images.decode_png(stream.getvalue()).shape == (13, 21, channels)


def test_jpeg_is_close(tmp_path: Path):
    row = np.linspace(0, 1, 64)
    image = np.stack(np.broadcast_arrays(row, row[:, None], 0.5), axis=-1)
    images.write_image(tmp_path / "a.jpg", image)
    assert np.abs(images.read_image(tmp_path / "a.jpg") - image).max() < 0.04


def test_channels_are_made_as_asked(tmp_path: Path):
    grey, rgb, rgba = picture(1), picture(3), picture(4)
    for name, image in (("grey", grey), ("rgb", rgb), ("rgba", rgba)):
        images.write_image(tmp_path / f"{name}.exr", image, half=False)
    read = {name: tmp_path / f"{name}.exr" for name in ("grey", "rgb", "rgba")}
    np.testing.assert_array_equal(images.read_image(read["grey"], 3), np.repeat(grey, 3, axis=2))
    np.testing.assert_array_equal(images.read_image(read["rgba"], 3), rgba[..., :3])
    np.testing.assert_array_equal(images.read_image(read["rgb"], 4)[..., :3], rgb)
    assert (images.read_image(read["rgb"], 4)[..., 3] == 1).all()
    np.testing.assert_array_equal(images.read_image(read["rgba"], 4), rgba)
    images.write_image(tmp_path / "even.exr", np.repeat(grey, 3, axis=2), half=False)
    np.testing.assert_array_equal(images.read_image(tmp_path / "even.exr", 1), grey)
    with pytest.raises(TronError, match=r"colours.*rgb\.exr"):
        images.read_image(read["rgb"], 1)


def test_exr_with_other_channels_says_which(tmp_path: Path):
    import OpenEXR

    layers = {"normal.X": picture(1)[..., 0], "normal.Y": picture(1)[..., 0]}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, layers).write(str(tmp_path / "a.exr"))
    with pytest.raises(TronError, match=r"normal\.X"):
        images.read_image(tmp_path / "a.exr")
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"depth": layers["normal.X"]}).write(
        str(tmp_path / "b.exr")
    )
    np.testing.assert_array_equal(images.read_image(tmp_path / "b.exr", 1), picture(1))


def test_failed_write_leaves_nothing(tmp_path: Path):
    for name, image in (("a.exr", picture(2)), ("a.png", np.zeros((0, 4, 3))), ("a.tiff", picture())):
        with pytest.raises(TronError):
            images.write_image(tmp_path / name, image)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name, data, said",
    [
        (
            "a.hdr",
            b"<!DOCTYPE html>\n<html><title>404</title></html>",
            "not a Radiance HDR image but a web page",
        ),
        ("a.hdr", b"\xef\xbb\xbf\n <HTML>", "not a Radiance HDR image but a web page"),
        (
            "a.hdr",
            b"version https://git-lfs.github.com/spec/v1\noid",
            "not a Radiance HDR image but a pointer",
        ),
        ("a.hdr", b"\x76\x2f\x31\x01\x02", "not a Radiance HDR image but an OpenEXR image"),
        ("a.hdr", b"", "not a Radiance HDR image: the file is empty"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n", "cut short in its header"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n+Y 4 +X 8\n", "cut short"),
        ("a.exr", b"<html>", "not an OpenEXR image but a web page"),
        ("a.exr", b"#?RADIANCE\n", "not an OpenEXR image but a Radiance HDR image"),
        ("a.png", b'{"error": "not found"}', "not a PNG or JPEG image but JSON"),
        ("a.jpg", b"\xff\xd8\xff\xe0 cut", "not a readable PNG or JPEG image"),
    ],
)
def test_a_file_of_another_kind_is_called_what_it_is(tmp_path: Path, name: str, data: bytes, said: str):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(TronError) as caught:
        images.read_image(tmp_path / name)
    assert said in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kept", [0.3, 0.9, 1.0])
def test_a_truncated_hdr_is_called_cut_short(tmp_path: Path, kept: float):
    path = tmp_path / "a.hdr"
    images.write_image(path, picture(3, 32, 64))
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data)) - 1])
    with pytest.raises(TronError, match="cut short"):
        images.read_image(path)


@pytest.mark.parametrize("encode", [images.encode_exr, images.encode_png], ids=["exr", "png"])
def test_damaged_bytes_never_escape_as_another_error(encode):
    """Flip, cut and repeat bytes at random: each file is either refused or gives a finite-sized image."""
    whole = encode(picture(3, 9, 11))
    decode = images.decode_exr if encode is images.encode_exr else images.decode_png
    rng = generator(0, "damage")
    refused = 0
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 4))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        try:
            assert decode(bytes(data[: len(whole) - int(rng.integers(0, 20))])).ndim == 3
        except TronError:
            refused += 1
    assert refused > 100


def test_real_light_probes_are_read(shared_data: Path):
    for path in sorted((shared_data / "hdri").glob("*.*")):
        if path.suffix in (".hdr", ".exr"):
            image = images.read_image(path)
            assert image.shape[1] == 2 * image.shape[0]
            assert np.isfinite(image).all()
            assert image.min() >= 0

"""Photos are read when they are looked at, as they are stored, and only so many are kept."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from tron.captures import LoadSettings, load_capture
from tron.captures.photos.photo_files import inspect_photo
from tron.captures.photos.photographs import PhotoCache, PhotoReader
from tron.errors import TronError
from tron.lenses import Lens
from tron.seeds import generator


def reader(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> PhotoReader:
    header = inspect_photo(path)
    width, height = header.size(upright)
    lens = Lens("PINHOLE", width, height, (50.0, 50.0, width / 2, height / 2))
    return PhotoReader(path, header, lens, size or (width, height), PhotoCache(10**7), upright)


def noise(*shape: int, dtype: type = np.uint8) -> np.ndarray:
    return generator(3, "noise").integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp", "webp"])
def test_eight_bits_come_back_as_they_were(tmp_path: Path, write, suffix: str) -> None:
    image = noise(7, 9, 3)
    path = tmp_path / f"a.{suffix}"
    if suffix == "webp":
        Image.fromarray(image).save(path, lossless=True)
    else:
        write.save(path, image)
    assert np.array_equal(np.round(reader(path).color() * 255).astype(np.uint8), image)


def test_sixteen_bits_keep_their_precision(tmp_path: Path, write) -> None:
    image = noise(7, 9, 3, dtype=np.uint16)
    write.save(tmp_path / "a.png", image)
    assert np.abs(reader(tmp_path / "a.png").color() * 65535 - image).max() < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_is_repeated(tmp_path: Path, write, dtype: type) -> None:
    image = noise(7, 9, dtype=dtype)
    write.save(tmp_path / "a.png", image)
    color = reader(tmp_path / "a.png").color()
    assert color.shape == (7, 9, 3)
    assert np.abs(color * np.iinfo(dtype).max - image[..., None]).max() < 0.01


def grey_png(values: np.ndarray, bits: int, hidden: int) -> bytes:
    """A grey PNG of 2, 8 or 16 bits whose chunk tRNS makes the value ``hidden`` transparent."""
    rows = b""
    for row in values.tolist():
        packed = 0
        for value in row:
            packed = packed << bits | value
        rows += b"\0" + packed.to_bytes(len(row) * bits // 8, "big")
    height, width = values.shape
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)),
        (b"tRNS", struct.pack(">H", hidden)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ]
    body = (struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


@pytest.mark.parametrize("bits, hidden", [(2, 1), (8, 200), (16, 40_000)])
def test_a_grey_png_with_one_transparent_value_is_transparent_there(tmp_path: Path, bits: int, hidden: int):
    values = generator(4, "grey").integers(0, 2**bits, (6, 8))
    values[2, 3:5] = hidden
    (tmp_path / "a.png").write_bytes(grey_png(values, bits, hidden))
    read = reader(tmp_path / "a.png")
    assert read.header.alpha
    np.testing.assert_array_equal(read.alpha(), values != hidden)
    np.testing.assert_allclose(read.color()[..., 1], values / (2**bits - 1), atol=1e-6)


@pytest.mark.parametrize("mode", ["P", "LA", "CMYK", "1"])
def test_unusual_modes_look_as_pillow_shows_them(tmp_path: Path, mode: str) -> None:
    smooth = Image.fromarray(np.linspace(0, 255, 48).astype(np.uint8).reshape(4, 4, 3))
    picture = smooth.convert(mode)
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    picture.save(path, quality=100)
    with Image.open(path) as stored:
        expected = np.asarray(stored.convert("RGB"), float)
    assert np.abs(reader(path).color() * 255 - expected).max() <= (12 if mode == "CMYK" else 0.01)


def test_alpha_is_a_mask_and_hidden_colours_do_not_bleed(tmp_path: Path, write) -> None:
    image = np.zeros((4, 8, 4), np.uint8)
    image[:, :3] = (200, 100, 50, 255)
    image[:, 3:] = (0, 255, 0, 0)  # green, but invisible
    write.save(tmp_path / "a.png", image)
    small = reader(tmp_path / "a.png", (4, 2))
    assert np.allclose(small.alpha(), [[1, 0.5, 0, 0]] * 2, atol=2 / 255)
    assert np.allclose(small.color()[:, :2] * 255, (200, 100, 50), atol=2)
    assert np.array_equal(reader(tmp_path / "a.png").color() * 255, image[..., :3])


def test_reduction_averages_areas(tmp_path: Path, write) -> None:
    image = noise(12, 18, 3)
    write.save(tmp_path / "a.png", image)
    means = image.reshape(4, 3, 6, 3, 3).mean((1, 3))
    assert np.abs(reader(tmp_path / "a.png", (6, 4)).color() * 255 - means).max() < 0.51


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_as_their_tag_says_only_if_asked(tmp_path: Path, orientation: int) -> None:
    stored = noise(6, 10, 3)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as picture:
        turned = np.asarray(ImageOps.exif_transpose(picture))
    as_stored, upright = reader(tmp_path / "a.png"), reader(tmp_path / "a.png", upright=True)
    assert np.array_equal(np.round(as_stored.color() * 255), stored)
    assert np.array_equal(np.round(upright.color() * 255), turned)


def damaged(data: bytes, kind: str) -> bytes:
    """A file of a right beginning and a right end whose middle is lost."""
    middle = len(data) // 2
    return {
        "zeros": data[:middle] + bytes(500) + data[middle + 500 :],
        "lost": data[:middle] + data[middle + 500 :],
        "ended": data[:middle] + data[-2:],
    }[kind]


@pytest.mark.parametrize("kind", ["zeros", "lost", "ended"])
@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_damaged_in_its_middle_is_found(tmp_path: Path, kind: str, progressive: bool) -> None:
    """Decoders fill what is lost with grey and say nothing; that grey must not be learnt."""
    data = jpeg(progressive=progressive)
    (tmp_path / "a.jpg").write_bytes(damaged(data, kind))
    with Image.open(tmp_path / "a.jpg") as picture:
        picture.verify()  # Pillow's own check sees nothing
    with pytest.raises(TronError, match="damaged or cut short"):
        inspect_photo(tmp_path / "a.jpg")


def test_a_text_under_the_name_of_a_photo_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("not a photo")
    with pytest.raises(TronError, match="damaged, or not an image"):
        inspect_photo(tmp_path / "a.jpg")


def test_a_png_damaged_in_its_middle_is_found(tmp_path: Path) -> None:
    Image.fromarray(noise(64, 80, 3)).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(damaged((tmp_path / "a.png").read_bytes(), "zeros"))
    with pytest.raises(TronError, match="damaged"):
        inspect_photo(tmp_path / "a.png")


def jpeg(**options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(noise(64, 80, 3)).save(stream, "JPEG", **options)
    return stream.getvalue()


def test_a_whole_jpeg_passes_with_or_without_bytes_behind_its_end(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg())
    (tmp_path / "b.jpg").write_bytes(jpeg(progressive=True) + b"SEFH, what a phone appends\0")
    for name in "ab":
        assert inspect_photo(tmp_path / f"{name}.jpg").size(False) == (80, 64)


@pytest.mark.parametrize(("left", "fill"), [(0.3, b""), (0.9, b"\0"), (0.99, b""), (0.99, b"\0")])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_what_was_cut_short_is_found_without_looking_at_it(
    tmp_path: Path, suffix: str, fill: bytes, left: float
) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "jpg":
        path.write_bytes(jpeg())
    else:
        Image.fromarray(noise(64, 80, 3)).save(path)
    data = path.read_bytes()
    kept = data[: int(left * len(data))]
    path.write_bytes(kept + fill * (len(data) - len(kept)))
    with pytest.raises(TronError) as caught:
        inspect_photo(path)
    assert "\n" not in str(caught.value)


def test_a_photo_that_changed_after_loading_is_refused(tmp_path: Path, write) -> None:
    write.save(tmp_path / "a.png", noise(6, 8, 3))
    before = reader(tmp_path / "a.png")
    write.save(tmp_path / "a.png", noise(8, 8, 3))
    with pytest.raises(TronError, match="changed since"):
        before.color()
    (tmp_path / "a.png").unlink()
    with pytest.raises(TronError, match="cannot read"):
        before.color()


def test_nothing_is_decoded_before_it_is_looked_at_and_memory_is_bounded(
    tmp_path: Path, photos, write, monkeypatch
) -> None:
    import tron.captures.photos.photographs as module

    decoded, decode = [], module.decode_photo
    monkeypatch.setattr(
        module, "decode_photo", lambda path, *rest: decoded.append(path.name) or decode(path, *rest)
    )
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    write.photos(tmp_path / "images", photos)
    width, height = write.size
    room = 3 * width * height * 3 + 10
    capture = load_capture(tmp_path, LoadSettings(cache_bytes=room))
    assert not decoded
    cache = capture.views[0].image.__self__.cache  # type: ignore[union-attr]
    for view in capture.views:
        view.read()
        assert cache.n_bytes <= room
    assert len(decoded) == len(photos.names)
    capture.views[-1].read()
    assert len(decoded) == len(photos.names)  # kept
    capture.views[0].read()
    assert len(decoded) == len(photos.names) + 1  # dropped


def test_a_cache_too_small_for_anything_keeps_nothing(tmp_path: Path, write) -> None:
    write.save(tmp_path / "a.png", noise(6, 8, 3))
    header = inspect_photo(tmp_path / "a.png")
    lens = Lens("PINHOLE", 8, 6, (5.0, 5.0, 4.0, 3.0))
    cache = PhotoCache(0)
    one = PhotoReader(tmp_path / "a.png", header, lens, (8, 6), cache)
    assert np.array_equal(one.color(), one.color())
    assert cache.n_bytes == 0

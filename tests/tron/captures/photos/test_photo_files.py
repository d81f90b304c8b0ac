"""HEIC and OpenEXR photos: what they show, and what is said where they cannot be read."""

import importlib.util
import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

import tron.captures.photos.photo_files as module
from tron.captures import LoadSettings, load_capture
from tron.captures.photos.photo_files import decode_photo, exposure_of, inspect_photo, open_photo, shown
from tron.captures.posing.structure_from_motion import _copy
from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.io.images import encode_exr
from tron.seeds import generator

SIZE = (64, 48)


def smooth(size: tuple[int, int] = SIZE) -> np.ndarray:
    """(H, W, 3) uint8 with colours that lossy codecs keep."""
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    return np.round(255 * np.stack([x, y, 0.5 + 0 * x], axis=-1)).astype(np.uint8)


@pytest.fixture
def heic(tmp_path: Path) -> Path:
    pillow_heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    exif = Image.Exif()
    exif[0x0110] = "phone"
    picture = pillow_heif.from_pillow(Image.fromarray(smooth()))
    picture.save(tmp_path / "a.heic", quality=95, exif=exif.tobytes())
    return tmp_path / "a.heic"


def test_a_heic_photo_is_what_was_stored(heic: Path) -> None:
    header = inspect_photo(heic)
    assert (header.width, header.height, header.alpha, header.linear) == (*SIZE, False, False)
    assert np.abs(decode_photo(heic, header).astype(int) - smooth()).mean() < 2
    with open_photo(heic, header) as picture:
        assert picture.getexif()[0x0110] == "phone"  # photos of one camera share its intrinsics


def test_a_capture_may_be_of_heic_photos(heic: Path, photos, write) -> None:
    content = write.transforms(photos, "")
    del content["w"], content["h"], content["cx"], content["cy"]
    for frame in content["frames"]:
        name = Path(frame["file_path"]).with_suffix(".HEIC")
        (heic.parent / name).write_bytes(heic.read_bytes())
        frame["file_path"] = str(name)
    content["frames"] = content["frames"][:3]
    write.json(heic.parent / "transforms.json", content)
    for frame in content["frames"][1:]:
        data = bytearray((heic.parent / frame["file_path"]).read_bytes())
        (heic.parent / frame["file_path"]).write_bytes(data)
    capture = load_capture(heic.parent)
    assert len(capture.views) == 3
    assert np.abs(capture.views[0].read() * 255 - smooth()).mean() < 2


def test_a_heic_photo_that_was_cut_short_is_found(heic: Path) -> None:
    heic.write_bytes(heic.read_bytes()[:-200])
    with pytest.raises(TronError, match=r"a.heic") as caught:
        inspect_photo(heic)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("posed", [True, False])
def test_without_its_library_heic_is_refused_in_one_line(
    tmp_path: Path, photos, write, monkeypatch, posed: bool
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == "pillow_heif" else find(name))
    write.photos(tmp_path, photos)
    (tmp_path / photos.names[4]).rename(tmp_path / "photo_04.heic")
    if posed:
        write.json(tmp_path / "transforms.json", write.transforms(photos, ""))
    with pytest.raises(TronError, match="HEIC, which is read with pillow-heif") as caught:
        load_capture(tmp_path)
    assert "pip install 'tron-relight[heic]'" in str(caught.value)
    assert "\n" not in str(caught.value)


def radiance(scale: float = 1.0) -> np.ndarray:
    """(H, W, 3) linear, from 0 to 8."""
    return (scale * 8 * (smooth() / 255) ** 3).astype(np.float32)


def test_linear_photos_are_shown_through_the_curve_that_photos_are_decoded_with() -> None:
    values = np.linspace(0, 1, 50)
    np.testing.assert_allclose(srgb_to_linear(shown(values / 0.25, 0.25)), values, atol=1e-6)
    assert shown(np.array([-1.0, 5.0]), 1.0).tolist() == [0, 1]


def test_an_exr_photo_is_exposure_times_radiance(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(encode_exr(radiance(), half=False))
    header = inspect_photo(tmp_path / "a.exr")
    assert header.linear
    pixels = decode_photo(tmp_path / "a.exr", header, 0.1)
    np.testing.assert_allclose(srgb_to_linear(pixels / 65535), (0.1 * radiance()).clip(0, 1), atol=1e-4)
    copies = _copy({tmp_path / "a.exr": header}, tmp_path / "copies", 64, exr_exposure=0.1)
    with Image.open(tmp_path / "copies" / next(iter(copies))) as copy:
        assert np.abs(np.asarray(copy, float) / 255 - pixels / 65535).mean() < 0.01


def test_alpha_of_exr_is_premultiplied(tmp_path: Path) -> None:
    alpha = np.full((*SIZE[::-1], 1), 0.5, np.float32)
    (tmp_path / "a.exr").write_bytes(encode_exr(np.concatenate([radiance() * alpha, alpha], -1), half=False))
    pixels = decode_photo(tmp_path / "a.exr", inspect_photo(tmp_path / "a.exr"), 0.1) / 65535
    np.testing.assert_allclose(srgb_to_linear(pixels[..., :3]), (0.1 * radiance()).clip(0, 1), atol=1e-4)
    np.testing.assert_allclose(pixels[..., 3], 0.5, atol=1e-4)


def test_one_exposure_for_all_shows_nearly_everything(tmp_path: Path) -> None:
    paths = []
    for index, scale in enumerate((0.5, 1.0, 2.0)):
        paths.append(tmp_path / f"{index}.exr")
        paths[-1].write_bytes(encode_exr(radiance(scale), half=False))
    brightest = np.concatenate([radiance(scale).max(-1).ravel() for scale in (0.5, 1.0, 2.0)])
    exposure = exposure_of(paths, None)
    assert (exposure * brightest > 0.9).mean() == pytest.approx(0.02, abs=0.005)
    assert exposure_of(paths, 0.3) == 0.3
    assert exposure_of([tmp_path / "a.jpg"], None) == 1


def test_the_exposure_of_exr_photos_is_told(tmp_path: Path, photos, write, caplog) -> None:
    content = write.transforms(photos)
    for index, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/{index}.exr"
        (tmp_path / "images").mkdir(exist_ok=True)
        noise = generator(index, "exr").random((*write.size[::-1], 3), np.float32)
        (tmp_path / "images" / f"{index}.exr").write_bytes(encode_exr(noise))
    write.json(tmp_path / "transforms.json", content)
    caplog.set_level(logging.INFO)
    capture = load_capture(tmp_path, LoadSettings(exr_exposure=0.5))
    assert "10 EXR photos are shown with exposure 0.5 (exr_exposure) and the sRGB curve" in caplog.text
    assert {view.space for view in capture.views} == {"display"}


@pytest.mark.parametrize("damage", ["nan", "cut"])
def test_an_exr_photo_that_cannot_be_used_is_named(tmp_path: Path, damage: str) -> None:
    image = radiance()
    image[2, 3] = np.nan if damage == "nan" else 0
    data = encode_exr(image)
    (tmp_path / "a.exr").write_bytes(data if damage == "nan" else data[: len(data) // 2])
    with pytest.raises(TronError, match=r"a.exr"):
        decode_photo(tmp_path / "a.exr", inspect_photo(tmp_path / "a.exr"))


def linear_png(
    path: Path, pixels: np.ndarray, name: bytes = b"gAMA", content: bytes = b"\0\1\x86\xa0"
) -> None:
    """A PNG that says that its values are linear (gAMA of 1), or something else."""
    chunks = PngImagePlugin.PngInfo()
    chunks.add(name, content)
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(path, pnginfo=chunks)


def test_a_capture_counts_the_photos_whose_colours_it_converts(tmp_path: Path, photos, write, caplog) -> None:
    write.photos(tmp_path / "images", photos)
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    for index in (1, 2):
        linear_png(tmp_path / "images" / photos.names[index], write.picture(index))
    half = np.where(write.picture(1) > 128, 255, 100).astype(np.uint8)[..., 0]
    linear_png(tmp_path / "masks" / photos.names[1], half)
    linear_png(tmp_path / "images" / photos.names[3], write.picture(3), b"cICP", bytes([3, 13, 0, 1]))
    with caplog.at_level(logging.INFO):
        capture = load_capture(tmp_path)
    said = [record.getMessage() for record in caplog.records]
    (line,) = [each for each in said if "to sRGB" in each]
    assert line.endswith("of 2 photos colours are brought from what is stated by gAMA, gamma 1 to sRGB")
    assert "cICP is not converted (primaries 3" in " ".join(said)
    views = {view.name: view for view in capture.views}
    assert len(views) == 9
    np.testing.assert_allclose(
        views["photo_01"].read(), linear_to_srgb(write.picture(1) / 255), atol=0.51 / 255
    )
    np.testing.assert_array_equal(views["photo_00"].read(), write.picture(0).astype(np.float32) / 255)
    np.testing.assert_array_equal(views["photo_01"].believed(), half > 128)

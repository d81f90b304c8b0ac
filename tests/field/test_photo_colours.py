"""Pictures of display values in other colour spaces come out in sRGB; colour-science is the witness."""

import io
import logging
import struct
import zlib
from pathlib import Path

import colour
import numpy as np
import pytest
from PIL import Image

from tron.captures.photos.photo_files import decode_photo, inspect_photo, open_photo
from tron.errors import TronError
from tron.io.embedded_colors import colors_of_profile
from tron.io.images import decode_png, encode_png, read_image
from tron.seeds import generator

D50 = (0.9642, 1.0, 0.8249)
SIZE = (12, 16)
P3, ADOBE, WIDE = "Display P3", "Adobe RGB (1998)", "ITU-R BT.2020"


def values() -> np.ndarray:
    """(H, W, 3) that lie well within sRGB in each space below: eight bits are coarse at its border."""
    x, y = np.meshgrid(np.linspace(0, 1, SIZE[1]), np.linspace(0.25, 0.7, SIZE[0]))
    return np.stack([0.45 + 0.3 * x, y, 0.5 + 0 * x], axis=-1)


def srgb(linear: np.ndarray) -> np.ndarray:
    return colour.models.eotf_inverse_sRGB(np.clip(linear, 0, 1))


def linear_srgb(linear: np.ndarray, space: str) -> np.ndarray:
    return colour.RGB_to_RGB(linear, space, "sRGB", "Bradford")


def from_p3(encoded: np.ndarray) -> np.ndarray:
    return srgb(linear_srgb(colour.models.eotf_sRGB(encoded), P3))


def from_adobe(encoded: np.ndarray) -> np.ndarray:
    return srgb(linear_srgb(encoded ** (563 / 256), ADOBE))


def profile(space: str, curve: bytes) -> bytes:
    """A matrix profile (ICC.1:2010) of a colour space of colour-science, with this curve of all channels."""
    own = colour.RGB_COLOURSPACES[space]
    whites = colour.xy_to_XYZ(own.whitepoint), np.array(D50)
    adapted = (
        colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, "Bradford") @ own.matrix_RGB_to_XYZ
    )

    def xyz(vector) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(float(v) * 65536) for v in vector))

    text = space.encode() + b"\0"
    described = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78)
    tags = {b"desc": described, b"wtpt": xyz(D50), b"cprt": b"text\0\0\0\0CC0\0"}
    tags |= {name + b"XYZ": xyz(adapted[:, i]) for i, name in enumerate((b"r", b"g", b"b"))}
    tags |= {name + b"TRC": curve for name in (b"r", b"g", b"b")}
    table, body, at = b"", b"", 128 + 4 + 12 * len(tags)
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += struct.pack(">4s2I", name, at + len(body), len(content))
        body += content
    size = at + len(body)
    head = struct.pack(">I4sI4s4s4s", size, b"lcms", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", *(round(v * 65536) for v in D50))
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def gamma_curve(gamma: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256))


def table_curve() -> bytes:
    steps = np.round(colour.models.eotf_sRGB(np.linspace(0, 1, 1024)) * 65535).astype(">u2")
    return b"curv\0\0\0\0" + struct.pack(">I", 1024) + steps.tobytes()


SRGB_CURVE = b"para\0\0\0\0" + struct.pack(
    ">2H5i", 3, 0, *(round(v * 65536) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
)
ICC_P3, ICC_ADOBE = profile(P3, SRGB_CURVE), profile(ADOBE, gamma_curve(563 / 256))


def png(pixels: np.ndarray, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of (H, W, 3 or 4) uint8 or uint16 with these chunks before its pixels."""
    height, width, channels = pixels.shape
    depth = 8 * pixels.dtype.itemsize
    header = struct.pack(">2I5B", width, height, depth, {3: 2, 4: 6}[channels], 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(f">u{depth // 8}").tobytes() for row in pixels)
    data = b"\x89PNG\r\n\x1a\n"
    for name, content in [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]:
        data += struct.pack(">I", len(content)) + name + content
        data += struct.pack(">I", zlib.crc32(name + content))
    return data


def stored(bits: int, image: np.ndarray | None = None) -> np.ndarray:
    image = values() if image is None else image
    return np.round(image * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def icc_chunk(data: bytes) -> tuple[bytes, bytes]:
    return b"iCCP", b"icc\0\0" + zlib.compress(data)


def cicp(primaries: int, transfer: int) -> tuple[bytes, bytes]:
    return b"cICP", bytes([primaries, transfer, 0, 1])


def chrm(space: str) -> tuple[bytes, bytes]:
    own = colour.RGB_COLOURSPACES[space]
    numbers = [*own.whitepoint, *own.primaries.ravel()]
    return b"cHRM", struct.pack(">8I", *(round(float(v) * 1e5) for v in numbers))


def gama(gamma: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(gamma * 1e5))


def pillow(kind: str, **saved) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(stored(8)).save(stream, kind, **saved)
    return stream.getvalue()


def exif_of(space: int, index: str | None = None) -> bytes:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = space
    if index is not None:
        exif.get_ifd(0x8769)[0xA005] = {1: index}
    return exif.tobytes()


HDR = values() * 0.5


def from_hdr(name: str):
    return lambda v: srgb(linear_srgb(colour.eotf(v, name) / 203, WIDE))


CASES = {
    "p3.jpg": (lambda: pillow("JPEG", quality=100, subsampling=0, icc_profile=ICC_P3), from_p3),
    "adobe.jpg": (lambda: pillow("JPEG", quality=100, subsampling=0, icc_profile=ICC_ADOBE), from_adobe),
    "exif.jpg": (
        lambda: pillow("JPEG", quality=100, subsampling=0, exif=exif_of(0xFFFF, "R03")),
        from_adobe,
    ),
    "exif_2.jpg": (lambda: pillow("JPEG", quality=100, subsampling=0, exif=exif_of(2)), from_adobe),
    "p3_8.png": (lambda: png(stored(8), icc_chunk(ICC_P3)), from_p3),
    "p3_16.png": (lambda: png(stored(16), icc_chunk(ICC_P3)), from_p3),
    "table_16.png": (lambda: png(stored(16), icc_chunk(profile(P3, table_curve()))), from_p3),
    "adobe_16.png": (lambda: png(stored(16), icc_chunk(ICC_ADOBE)), from_adobe),
    "cicp_p3.png": (lambda: png(stored(16), cicp(12, 13)), from_p3),
    "cicp_pq.png": (lambda: png(stored(16, HDR), cicp(9, 16)), from_hdr("ITU-R BT.2100 PQ")),
    "cicp_hlg.png": (lambda: png(stored(16, HDR), cicp(9, 18)), from_hdr("ITU-R BT.2100 HLG")),
    "cicp_first.png": (lambda: png(stored(16), cicp(12, 13), icc_chunk(ICC_ADOBE), gama(1.0)), from_p3),
    "cicp_srgb.png": (lambda: png(stored(16), cicp(1, 13)), lambda v: v),
    "linear_16.png": (lambda: png(stored(16), gama(1.0)), srgb),
    "gamma_1.8.png": (lambda: png(stored(16), gama(1 / 1.8)), lambda v: srgb(v**1.8)),
    "chrm_p3.png": (lambda: png(stored(16), chrm(P3), gama(0.45455)), from_p3),
    "chrm_srgb.png": (lambda: png(stored(16), chrm("sRGB"), gama(0.45455)), lambda v: v),
    "tagged.png": (lambda: png(stored(16), (b"sRGB", b"\0"), gama(1.0)), lambda v: v),
    "untagged_16.png": (lambda: png(stored(16)), lambda v: v),
}


@pytest.mark.parametrize("name", CASES)
def test_a_picture_comes_out_in_srgb(tmp_path: Path, name: str):
    encode, witness = CASES[name]
    path = tmp_path / name
    path.write_bytes(encode())
    wanted = witness(HDR if name in ("cicp_pq.png", "cicp_hlg.png") else values())
    # Sixteen bits are kept but for the rounding of matrices and profiles; ImageCms and JPEG have eight.
    tolerance = 4 / 255 if path.suffix == ".jpg" else 2.5 / 255 if "_8" in name else 1e-3
    np.testing.assert_allclose(read_image(path), wanted, atol=tolerance)
    pixels = decode_photo(path, inspect_photo(path))
    np.testing.assert_allclose(pixels / np.iinfo(pixels.dtype).max, wanted, atol=tolerance)


def test_sixteen_bits_of_colours_are_kept():
    pixels = (generator(0, "sixteen").random((*SIZE, 4)) * 65535).astype(np.uint16)
    np.testing.assert_array_equal(np.round(decode_png(png(pixels)) * 65535), pixels)
    np.testing.assert_array_equal(np.round(decode_png(png(pixels[..., :3])) * 65535), pixels[..., :3])


def test_alpha_is_no_colour():
    pixels = np.concatenate([stored(16), stored(16)[..., :1]], axis=-1)
    decoded = decode_png(png(pixels, cicp(12, 13)))
    np.testing.assert_array_equal(np.round(decoded[..., 3] * 65535), pixels[..., 3])
    np.testing.assert_allclose(decoded[..., :3], from_p3(values()), atol=1e-3)


@pytest.mark.parametrize("mode", ["L", "P", "RGBA"])
def test_profiles_of_other_modes(mode: str, tmp_path: Path):
    picture = Image.fromarray(stored(8)).convert(mode)
    picture.save(tmp_path / "a.png", icc_profile=ICC_P3)
    rgb = np.asarray(picture.convert("RGB"))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), from_p3(rgb / 255), atol=2.5 / 255)


def test_a_profile_of_srgb_changes_nothing(tmp_path: Path):
    (tmp_path / "a.png").write_bytes(png(stored(8), icc_chunk(profile("sRGB", SRGB_CURVE))))
    np.testing.assert_array_equal(np.round(read_image(tmp_path / "a.png") * 255), stored(8))
    header = inspect_photo(tmp_path / "a.png")
    assert header.notes == ()


@pytest.mark.parametrize("kept", ["icc", "nclx"])
def test_heic_in_p3(tmp_path: Path, kept: str):
    heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    picture = heif.from_pillow(Image.fromarray(stored(8, np.tile(values(), (4, 4, 1)))))
    tags = (
        {"icc_profile": ICC_P3} if kept == "icc" else {"color_primaries": 12, "transfer_characteristics": 13}
    )
    picture.info.update({"icc_profile": ICC_P3} if kept == "icc" else {})
    picture.save(tmp_path / "a.heic", quality=-1, chroma=444, save_nclx_profile=True, **tags)
    header = inspect_photo(tmp_path / "a.heic")
    assert "to sRGB" in header.notes[0]
    found = decode_photo(tmp_path / "a.heic", header) / 255
    np.testing.assert_allclose(found, np.tile(from_p3(values()), (4, 4, 1)), atol=4 / 255)


@pytest.mark.parametrize("primaries, transfer", [(3, 13), (1, 9), (250, 250)])
def test_a_colour_space_that_is_not_converted_is_refused(tmp_path: Path, primaries: int, transfer: int):
    (tmp_path / "a.png").write_bytes(png(stored(8), cicp(primaries, transfer)))
    for read in (read_image, inspect_photo):
        with pytest.raises(TronError, match=rf"cICP is not converted .*{primaries}.*{transfer}.*a\.png"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize(
    "data, said",
    [
        (b"no profile at all", "ICC profile is damaged"),
        (ICC_P3[:16] + b"CMYK" + ICC_P3[20:], "is of CMYK"),
    ],
)
def test_a_profile_that_is_of_no_use_is_a_line(data: bytes, said: str):
    (note,) = colors_of_profile(data, "RGB").notes()
    assert said in note
    assert "read as sRGB" in note


@pytest.mark.parametrize(
    "space, profile, said",
    [
        (1, None, ""),
        (0xFFFF, None, "EXIF says that its colours are not sRGB's"),
        (0xFFFF, ICC_P3, "colours are brought from Display P3"),
    ],
)
def test_a_profile_that_was_lost_is_a_line(tmp_path: Path, space: int, profile: bytes | None, said: str):
    """EXIF's ColorSpace of 65535 stands for another space than sRGB; the profile says which."""
    (tmp_path / "a.jpg").write_bytes(pillow("JPEG", exif=exif_of(space), icc_profile=profile))
    assert len(inspect_photo(tmp_path / "a.jpg").notes) == (said != "")
    assert said in "".join(inspect_photo(tmp_path / "a.jpg").notes)


def test_what_is_no_colour_is_not_converted(tmp_path: Path):
    (tmp_path / "normal.png").write_bytes(png(stored(16), icc_chunk(ICC_P3), gama(1.0)))
    np.testing.assert_allclose(read_image(tmp_path / "normal.png", color=False), values(), atol=1e-5)
    header = inspect_photo(tmp_path / "normal.png", color=False)
    np.testing.assert_array_equal(decode_photo(tmp_path / "normal.png", header), stored(16))


def test_what_is_converted_is_said(tmp_path: Path, caplog):
    (tmp_path / "a.png").write_bytes(png(stored(8), icc_chunk(ICC_P3)))
    with caplog.at_level(logging.INFO):
        read_image(tmp_path / "a.png")
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.endswith("a.png: colours are brought from Display P3 (ICC profile) to sRGB")


def test_our_pictures_say_that_they_are_srgb():
    assert b"sRGB\0" in encode_png(values())
    assert b"sRGB\0" not in encode_png(values()[..., :1])
    assert b"sRGB\0" not in encode_png(values(), color=False)


def test_the_copy_that_poses_are_found_in_is_in_srgb_and_keeps_its_exif(tmp_path: Path):
    exif = Image.Exif()
    exif[0x0110] = "phone"
    data = pillow("JPEG", quality=100, subsampling=0, icc_profile=ICC_P3, exif=exif.tobytes())
    (tmp_path / "a.jpg").write_bytes(data)
    with open_photo(tmp_path / "a.jpg", inspect_photo(tmp_path / "a.jpg")) as picture:
        np.testing.assert_allclose(np.asarray(picture) / 255, from_p3(values()), atol=4 / 255)
        assert picture.getexif()[0x0110] == "phone"


def test_heic_in_hlg_keeps_its_bits(tmp_path: Path):
    heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    data = np.tile(stored(16, HDR), (4, 4, 1))
    picture = heif.from_bytes("RGB;16", (data.shape[1], data.shape[0]), data.tobytes())
    picture.save(tmp_path / "a.heic", quality=-1, chroma=444, color_primaries=9, transfer_characteristics=18)
    header = inspect_photo(tmp_path / "a.heic")
    assert "what is brighter than its white" in header.notes[1]
    found = decode_photo(tmp_path / "a.heic", header)
    assert found.dtype == np.uint16
    wanted = from_hdr("ITU-R BT.2100 HLG")(np.tile(HDR, (4, 4, 1)))
    np.testing.assert_allclose(found / 65535, wanted, atol=4 / 255)


@pytest.mark.parametrize("profile", [b"no profile", ICC_P3])
@pytest.mark.parametrize("color", [True, False])
def test_inks_without_a_profile_of_inks_are_no_transparency(tmp_path, profile: bytes, color: bool):
    plain, tagged = tmp_path / "plain.jpg", tmp_path / "tagged.jpg"
    picture = Image.new("CMYK", (8, 8), (0, 200, 200, 10))
    picture.save(plain, quality=95)
    picture.save(tagged, quality=95, icc_profile=profile)
    wanted, found = (read_image(path, None, color=color) for path in (plain, tagged))
    assert found.shape == (8, 8, 3)
    np.testing.assert_allclose(found, wanted, atol=2 / 255)

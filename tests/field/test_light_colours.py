"""One light in many encodings, as the light that comes out, against colour-science and writers of its own."""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import colour
import numpy as np
import OpenEXR
import pytest

from tron.errors import TronError
from tron.io.images import encode_exr, read_image
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

HEIGHT, WIDTH = 8, 16
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
RADIANCE_P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)


def chromaticities(name: str) -> tuple[float, ...]:
    space = colour.RGB_COLOURSPACES[name]
    return (*space.primaries.ravel(), *space.whitepoint)


def matrix(source: str, target: str) -> np.ndarray:
    """Of colour-science, by Bradford; XYZ is not adapted."""
    spaces = [colour.RGB_COLOURSPACES[name] for name in (source, target) if name != "XYZ"]
    for space in spaces:
        space.use_derived_transformation_matrices(True)
    try:
        if source == "XYZ":
            return spaces[0].matrix_XYZ_to_RGB.copy()
        if target == "XYZ":
            return spaces[0].matrix_RGB_to_XYZ.copy()
        return colour.matrix_RGB_to_RGB(spaces[0], spaces[1], "Bradford")
    finally:
        for space in spaces:
            space.use_derived_transformation_matrices(False)


def mantissas(values: np.ndarray) -> np.ndarray:
    """(..., 4) uint8: mantissas and exponent."""
    exponent = np.floor(np.log2(values.max(-1, keepdims=True))).astype(int) + 1
    return np.concatenate([np.round(values * 2.0 ** (8 - exponent)), exponent + 128], -1).astype(np.uint8)


def of_mantissas(pixels: np.ndarray) -> np.ndarray:
    return pixels[..., :3] * 2.0 ** (pixels[..., 3:].astype(int) - 136)


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    """(H, W, 3) whose colours eight bits hold in BT.709, XYZ and P3 alike, so that each encoding is exact."""
    drawn = generator(0, "light").integers(70, 256, (500_000, 3)) / 128
    error = np.zeros(len(drawn))
    for target in ("XYZ", "P3-D65"):
        there = matrix("sRGB", target)
        stored = of_mantissas(mantissas(drawn @ there.T)) @ np.linalg.inv(there).T
        error = np.maximum(error, np.abs(stored / drawn - 1).max(-1))
    best = np.argsort(error)[:WIDTH]
    assert error[best].max() < 9e-4
    return np.stack([np.roll(drawn[best], 3 * row, axis=0) for row in range(HEIGHT)])


def exr(image: np.ndarray, space: tuple[float, ...] | None) -> bytes:
    return exr_of({"RGB": np.asarray(image, np.float32)}, {} if space is None else {"chromaticities": space})


def exr_of(channels: dict, header: dict) -> bytes:
    stream = io.BytesIO()
    known = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(known | header, channels).write(stream)
    return stream.getvalue()


def chroma_exr(image: np.ndarray, space: tuple[float, ...] | None) -> bytes:
    """Y, RY and BY, the chroma at half the size, of an image of blocks of 2 x 2 equal chromas."""
    corners = np.reshape(space or chromaticities("sRGB"), (4, 2))
    weights = colour.normalised_primary_matrix(corners[:3], corners[3])[1]
    y = image @ weights
    planes = {"Y": OpenEXR.Channel("Y", y.astype(np.float32), 1, 1)}
    for name, index in (("RY", 0), ("BY", 2)):
        half = (image[..., index] / y - 1)[::2, ::2].astype(np.float32)
        # The binding takes the first numbers of an array of the full size.
        stored = np.zeros(y.shape, np.float32)
        stored.ravel()[: half.size] = half.ravel()
        planes[name] = OpenEXR.Channel(name, stored, 2, 2)
    return exr_of(planes, {} if space is None else {"chromaticities": space})


def hdr(
    image: np.ndarray, *lines: str, end: str = "\n", axes: str = "-Y {h} +X {w}", flat: bool = False
) -> bytes:
    """Radiance HDR of scanlines, with run lengths by channel unless ``flat``."""
    pixels = mantissas(image)
    head = end.join(["#?RADIANCE", *lines, "", axes.format(h=image.shape[0], w=image.shape[1])]) + end
    return head.encode() + (pixels.tobytes() if flat else b"".join(runs(row) for row in pixels))


def runs(row: np.ndarray) -> bytes:
    data = struct.pack(">2BH", 2, 2, len(row))
    for channel in row.T:
        at = 0
        while at < len(channel):
            same = 1
            while at + same < len(channel) and same < 127 and channel[at + same] == channel[at]:
                same += 1
            data += bytes([128 + same, channel[at]]) if same > 1 else bytes([1, channel[at]])
            at += same
    return data


def old_runs(image: np.ndarray, times: int) -> bytes:
    """Each pixel ``times`` over: (1, 1, 1, low), then (1, 1, 1, high) where it is more than 255."""
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (image.shape[0], image.shape[1] * times)
    for pixel in mantissas(image).reshape(-1, 4):
        data += pixel.tobytes() + bytes([1, 1, 1, (times - 1) % 256])
        data += bytes([1, 1, 1, (times - 1) // 256]) if times > 256 else b""
    return data


RGBE, XYZE = "FORMAT=32-bit_rle_rgbe", "FORMAT=32-bit_rle_xyze"
P3_LINE = "PRIMARIES= " + " ".join(map(str, RADIANCE_P3))
Encode = Callable[[np.ndarray], bytes]


def in_space(name: str) -> Encode:
    return lambda light: exr(light @ matrix("sRGB", name).T, chromaticities(name))


def in_p3(light: np.ndarray) -> np.ndarray:
    return light @ matrix("sRGB", "P3-D65").T


ENCODINGS: dict[str, Encode] = {
    "bt709.exr": lambda light: exr(light, None),
    "aces.exr": in_space("ACES2065-1"),
    "acescg.exr": in_space("ACEScg"),
    "p3.exr": in_space("Display P3"),
    "bt2020.exr": in_space("ITU-R BT.2020"),
    "adobe.exr": in_space("Adobe RGB (1998)"),
    "xyz.exr": lambda light: exr(light @ matrix("sRGB", "XYZ").T, XYZ),
    "interop.exr": lambda light: exr_of(
        {"RGB": (light @ matrix("sRGB", "ACEScg").T).astype(np.float32)}, {"colorInteropID": "lin_ap1_scene"}
    ),
    "rgbe.hdr": lambda light: hdr(light, RGBE),
    "zeros.hdr": lambda light: hdr(light, "GAMMA=1", "PRIMARIES=0 0 0 0 0 0 0 0", RGBE),
    "primaries.hdr": lambda light: hdr(in_p3(light), RGBE, P3_LINE),
    "exposure.hdr": lambda light: hdr(light, RGBE, "EXPOSURE= 4", "EXPOSURE=0.5"),
    "primaries_exposure.hdr": lambda light: hdr(in_p3(light) * 8, RGBE, P3_LINE, "EXPOSURE=8"),
    "colorcorr.hdr": lambda light: hdr(light, RGBE, "COLORCORR= 2 2 2", "COLORCORR=0.25 0.25 0.25"),
    "xyze.hdr": lambda light: hdr(light @ matrix("sRGB", "XYZ").T, XYZE),
    "no_format.hdr": lambda light: hdr(light, "SOFTWARE=x"),
    "no_fields.hdr": lambda light: hdr(light),
    "crlf.hdr": lambda light: hdr(light, RGBE, end="\r\n"),
    "flat.hdr": lambda light: hdr(light, RGBE, flat=True),
    "rows_up.hdr": lambda light: hdr(light[::-1], RGBE, axes="+Y {h} +X {w}"),
    "mirrored.hdr": lambda light: hdr(light[:, ::-1], RGBE, axes="-Y {h} -X {w}"),
    "turned.hdr": lambda light: hdr(light.transpose(1, 0, 2), RGBE, axes="+X {h} -Y {w}"),
    "turned_about.hdr": lambda light: hdr(light.transpose(1, 0, 2)[::-1, ::-1], RGBE, axes="-X {h} +Y {w}"),
}
SCALED = {"exposure.hdr": 0.5, "colorcorr.hdr": 2.0}


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_light_is_the_same_in_every_encoding(tmp_path: Path, light: np.ndarray, name: str):
    (tmp_path / name).write_bytes(ENCODINGS[name](light))
    found = EnvironmentMap.load(tmp_path / name).image
    np.testing.assert_allclose(found, light * SCALED.get(name, 1.0), rtol=1e-3)


@pytest.mark.parametrize("space", [None, "ACEScg"])
def test_luminance_and_chroma_become_colours(tmp_path: Path, light: np.ndarray, space: str | None):
    chroma = light[:1, :1] / light[:1, :1].mean()
    smooth = light.mean(-1, keepdims=True) * chroma
    stored = smooth if space is None else smooth @ matrix("sRGB", space).T
    data = chroma_exr(stored, None if space is None else chromaticities(space))
    (tmp_path / "a.exr").write_bytes(data)
    np.testing.assert_allclose(EnvironmentMap.load(tmp_path / "a.exr").image, smooth, rtol=1e-3)


def test_chroma_between_its_samples_is_linear(tmp_path: Path):
    ramp = np.linspace(0.5, 1.5, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 1))
    image = np.concatenate([ramp, np.ones_like(ramp), 2 - ramp], axis=-1)
    (tmp_path / "a.exr").write_bytes(chroma_exr(image, None))
    # The last column has a sample on its left alone.
    np.testing.assert_allclose(read_image(tmp_path / "a.exr")[:, :-1], image[:, :-1], rtol=2e-3)


@pytest.mark.parametrize("times", [3, 200, 700])
def test_old_run_lengths_repeat_pixels(tmp_path: Path, light: np.ndarray, times: int):
    (tmp_path / "a.hdr").write_bytes(old_runs(light[:2, :3], times))
    found = read_image(tmp_path / "a.hdr")
    np.testing.assert_allclose(found, np.repeat(light[:2, :3], times, axis=1), rtol=1e-3)


REFUSED = {
    "format.hdr": (lambda light: hdr(light, "FORMAT=32-bit_rle_cmyk"), "FORMAT=32-bit_rle_cmyk"),
    "exposure.hdr": (lambda light: hdr(light, RGBE, "EXPOSURE=0"), "EXPOSURE or COLORCORR"),
    "word.hdr": (lambda light: hdr(light, RGBE, "EXPOSURE=bright"), "EXPOSURE=bright"),
    "primaries.hdr": (lambda light: hdr(light, RGBE, "PRIMARIES=1 2 3"), "give 8 numbers"),
    "space.hdr": (lambda light: hdr(light, RGBE, "PRIMARIES=" + " 0.3" * 8), "no colour space"),
    "space.exr": (lambda light: exr(light, (0.3,) * 8), "no colour space"),
    "cut.hdr": (lambda light: hdr(light, RGBE, flat=True)[:-9], "cut short"),
    "first_run.hdr": (lambda light: b"#?RADIANCE\n\n-Y 8 +X 16\n" + bytes([1, 1, 1, 255]) * 9, "cut short"),
    "axes.hdr": (lambda light: hdr(light, RGBE, axes="-Y {h} +Y {w}"), "two axes"),
    "nan.exr": (
        lambda light: exr(np.where(light == light.max(), np.nan, light), None),
        "of 128 texels are NaN",
    ),
    "negative.exr": (lambda light: exr(light - 2, None), "negative radiance"),
    "dark.exr": (lambda light: exr(np.full_like(light, np.inf), None), "no finite radiance"),
    "square.exr": (lambda light: exr(light[:, :8], None), "not 2:1"),
    "layers.exr": (
        lambda light: exr_of({f"{n}.{c}": light[..., 0].astype("f") for n in ("a", "b") for c in "RGB"}, {}),
        "layers a, b",
    ),
    "light.tif": (lambda light: b"", "cannot hold an environment map"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path: Path, light: np.ndarray, name: str):
    encode, said = REFUSED[name]
    (tmp_path / name).write_bytes(encode(light))
    with pytest.raises(TronError) as caught:
        EnvironmentMap.load(tmp_path / name)
    assert said in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_a_file_says_of_its_colours_is_logged_once(tmp_path: Path, light: np.ndarray, caplog):
    (tmp_path / "a.exr").write_bytes(exr(light, chromaticities("ACEScg")))
    (tmp_path / "b.exr").write_bytes(
        exr_of({"RGB": light.astype("f")}, {"oiio:ColorSpace": "Filmlight T-Log"})
    )
    with caplog.at_level("INFO"):
        for _ in range(2):
            read_image(tmp_path / "a.exr")
            read_image(tmp_path / "b.exr")
    first, second = (record.getMessage() for record in caplog.records)
    assert "from ACEScg to BT.709" in first
    assert "'Filmlight T-Log' is not known here" in second


def test_what_is_no_colour_is_not_converted(tmp_path: Path, light: np.ndarray):
    (tmp_path / "normals.exr").write_bytes(exr(light, chromaticities("ACEScg")))
    np.testing.assert_array_equal(read_image(tmp_path / "normals.exr", color=False), light.astype(np.float32))


def test_our_files_say_what_they_hold(light: np.ndarray):
    header = OpenEXR.File(io.BytesIO(encode_exr(light))).header()
    np.testing.assert_allclose(header["chromaticities"], chromaticities("sRGB"), atol=1e-6)
    assert "chromaticities" not in OpenEXR.File(io.BytesIO(encode_exr(light[..., :1]))).header()
    assert "chromaticities" not in OpenEXR.File(io.BytesIO(encode_exr(light, color=False))).header()


def test_cases_of_the_field_hold_one_light(shared_data: Path):
    folder = shared_data / "field"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    base = EnvironmentMap.load(folder / "exr-chromaticities" / "base.exr").image
    for path in sorted(folder.glob("exr-chromaticities/*.exr")):
        np.testing.assert_allclose(EnvironmentMap.load(path).image, base, rtol=4e-3, err_msg=path.name)
    for path in sorted(folder.glob("radiance-variants/*.hdr")):  # eight bits
        off = np.abs(EnvironmentMap.load(path).image - base).max(-1) / base.max(-1)
        assert off.max() < 0.025, path.name

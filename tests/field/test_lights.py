"""Lights as they are found: infinite suns, layers of Blender, a column too few, pictures for a display."""

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from tron.color import srgb_to_linear
from tron.io.exr_files import _NAMES
from tron.io.images import encode_exr, encode_jpeg, encode_png, write_image
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap


def light(height: int = 16, width: int | None = None) -> np.ndarray:
    """Smooth, with a bright patch: what is resampled keeps its mean."""
    width = 2 * height if width is None else width
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, np.arange(height) / (height - 1))
    image = np.stack([1 + 0.5 * np.sin(2 * np.pi * u), 1 + v, np.full_like(u, 0.7)], axis=-1)
    return image.astype(np.float32)


def said(caplog: pytest.LogCaptureFixture) -> str:
    return "\n".join(record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("half", [True, False])
def test_infinite_texels_become_the_largest_finite_value(tmp_path: Path, caplog, half: bool):
    image = light()
    image[2, 3:6], image[4, 4, 1] = np.inf, 500
    write_image(tmp_path / "sun.exr", image, half)
    found = EnvironmentMap.load(tmp_path / "sun.exr")
    assert (found.image[2, 3:6] == 500).all()
    assert np.isfinite(found.exposure())
    assert "3 of 512 texels are infinite" in said(caplog)
    assert "sun.exr" in said(caplog)


@pytest.mark.parametrize("space", ["P3", "ACEScg", "BT.2020"])
def test_suns_and_saturated_colours_of_wide_gamuts_are_lights(tmp_path: Path, caplog, space: str):
    """No channel of what the file holds is negative; BT.709 has none for such a green, so it is clipped."""
    image = np.full((16, 32, 3), (0.0, 1.0, 0.0), np.float32)
    image[2, 3] = np.inf, 5, 1
    header = {"chromaticities": _NAMES[space], "type": OpenEXR.scanlineimage}
    path = tmp_path / "wide.exr"
    path.write_bytes(encoded(OpenEXR.Part(header, {"RGB": image}, "all")))
    found = EnvironmentMap.load(path).image
    assert np.isfinite(found).all()
    assert found.min() == 0
    assert found[8, 8, 1] > 0.9
    assert found[2, 3] == pytest.approx(found.max())
    assert "1 of 512 texels are infinite" in said(caplog)


def test_small_negative_values_become_zero(tmp_path: Path, caplog):
    image = light()
    image[3, 3:5, 0] = -1e-3
    write_image(tmp_path / "ringing.exr", image, half=False)
    found = EnvironmentMap.load(tmp_path / "ringing.exr").image
    np.testing.assert_array_equal(found, np.maximum(image, 0))
    assert "2 of 512 texels are negative (down to -0.001)" in said(caplog)


def layers(*names: str) -> dict[str, np.ndarray]:
    """Channels as Blender writes them; every layer but Combined is noise."""
    channels = {}
    for name in names:
        image = light() if name.endswith("Combined") else generator(0, name).random((16, 32, 3), np.float32)
        channels |= {f"{name}.{letter}": image[..., i].copy() for i, letter in enumerate("RGB")}
    return channels


def encoded(*parts: Any) -> bytes:
    stream = io.BytesIO()
    OpenEXR.File(list(parts)).write(stream)
    return stream.getvalue()


def part(channels: dict[str, np.ndarray], name: str = "all") -> Any:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    return OpenEXR.Part(header, channels, name)


ALPHA = {"View Layer.Combined.A": np.ones((16, 32), np.float32), "View Layer.Depth.Z": light()[..., 0].copy()}


@pytest.mark.parametrize(
    "data, left_out",
    [
        (
            lambda: encoded(part(layers("View Layer.Combined", "View Layer.DiffCol") | ALPHA)),
            "View Layer.DiffCol",
        ),
        (lambda: encoded(part(layers("ViewLayer.Combined"))), ""),
        (lambda: encoded(part(layers("Composite.Combined", "View Layer.Combined"))), "View Layer.Combined"),
        (lambda: encoded(part(layers("A.GlossDir"), "a"), part(layers("A.Combined"), "b")), "A.GlossDir"),
        (
            lambda: encoded(
                part({"Z": light()[..., 0].copy()}, "ViewLayer.Depth"),
                part({"RGB": light()}, "ViewLayer.Combined"),
                part({"RGB": 9 * light()}, "ViewLayer.Emit"),
            ),
            "ViewLayer.Emit",
        ),
    ],
    ids=["multilayer", "alone", "composite", "parts", "named parts"],
)
def test_blenders_layers_are_read_by_combined(tmp_path: Path, caplog, data, left_out: str):
    (tmp_path / "blender.exr").write_bytes(data())
    with caplog.at_level(logging.INFO):
        found = EnvironmentMap.load(tmp_path / "blender.exr")
    np.testing.assert_array_equal(found.image, light())
    assert "Combined' is read" in said(caplog)
    assert left_out in said(caplog)


@pytest.mark.parametrize(
    "height, width, after", [(16, 31, 16), (32, 63, 32), (15, 32, 16), (16, 33, 17), (16, 30, 15)]
)
def test_a_width_that_is_off_by_a_column_is_resampled(
    tmp_path: Path, caplog, height: int, width: int, after: int
):
    write_image(tmp_path / "off.hdr", light(height, width))
    found = EnvironmentMap.load(tmp_path / "off.hdr")
    assert found.image.shape == (after, 2 * after, 3)
    np.testing.assert_allclose(found.mean(), EnvironmentMap(light(64)).mean(), rtol=0.01)
    directions = EnvironmentMap(light(64)).directions()[8:-8:8, ::8]
    np.testing.assert_allclose(
        found.lookup(directions), EnvironmentMap(light(64)).lookup(directions), rtol=0.05
    )
    assert f"{width} x {height} pixels are resampled to {2 * after} x {after}" in said(caplog)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg"])
def test_a_panorama_of_display_values_is_a_light_that_is_called_clipped(tmp_path: Path, caplog, suffix: str):
    shown = np.clip(light() / 2.2, 0, 1)
    data = encode_png(shown) if suffix == ".png" else encode_jpeg(shown)
    (tmp_path / f"panorama{suffix}").write_bytes(data)
    found = EnvironmentMap.load(tmp_path / f"panorama{suffix}").image
    np.testing.assert_allclose(found, srgb_to_linear(shown), atol=0.005 if suffix == ".png" else 0.06)
    assert "range is clipped" in said(caplog)


def test_a_panorama_of_sixteen_bits_keeps_them(tmp_path: Path):
    values = (generator(0, "sixteen").random((8, 16)) * 65535).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    found = EnvironmentMap.load(tmp_path / "a.png").image
    np.testing.assert_allclose(found[..., 1], srgb_to_linear(values / 65535), rtol=1e-4)


def test_a_light_that_needs_nothing_says_nothing(tmp_path: Path, caplog):
    (tmp_path / "a.exr").write_bytes(encode_exr(light()))
    with caplog.at_level(logging.INFO):
        EnvironmentMap.load(tmp_path / "a.exr")
    assert said(caplog) == ""

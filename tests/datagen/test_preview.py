"""A shard's contact sheet: what is no light is shown as an image editor shows it."""

import numpy as np
import pytest
from PIL import ImageColor

from datagen.preview import displayable
from tron.shards.schema import MEMBERS

REFLECTANCES = [name for name in MEMBERS if name.startswith("base_color") or name == "albedo"]


@pytest.mark.parametrize("member", REFLECTANCES)
def test_reflectance_is_shown_through_the_srgb_curve(member: str):
    # CSS colours are sRGB; their linear values by the curve of IEC 61966-2-1: 0.0047 is on its straight part.
    encoded = np.array([ImageColor.getrgb(name) for name in ("gray", "orange", "#0e0f10")], np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(displayable(member, linear[None])[0], encoded, atol=1e-5)


def test_normals_are_shown_by_halves_and_none_is_black():
    shown = displayable("normal", np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]], np.float32))
    np.testing.assert_allclose(shown, [[[0.5, 0.5, 1.0], [0.0, 0.0, 0.0]]])

"""Colour against independent witnesses: colour-science, OpenColorIO and the published AgX configuration."""

from importlib import import_module
from typing import Any

import colour
import numpy as np
import pytest
import torch

from tron import color
from tron.seeds import generator

ocio: Any = import_module("PyOpenColorIO")  # its stubs name nothing

# Computed by OpenColorIO 2.6 from the public configuration github.com/sobotka/AgX at a66ad4b,
# "Linear BT.709" -> "AgX Base": linear RGB, display RGB.
PUBLISHED = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.001, 0.001, 0.001, 0.015156, 0.015154, 0.015154],
        [0.01, 0.01, 0.01, 0.096163, 0.096151, 0.09615],
        [0.05, 0.05, 0.05, 0.281937, 0.28191, 0.281908],
        [0.18, 0.18, 0.18, 0.500023, 0.499992, 0.49999],
        [0.5, 0.5, 0.5, 0.677212, 0.677183, 0.677181],
        [1.0, 1.0, 1.0, 0.787536, 0.787511, 0.78751],
        [2.0, 2.0, 2.0, 0.876274, 0.876255, 0.876254],
        [5.0, 5.0, 5.0, 0.952363, 0.952352, 0.952352],
        [10.0, 10.0, 10.0, 0.985147, 0.985141, 0.98514],
        [100.0, 100.0, 100.0, 1.0, 1.0, 1.0],
        [1.0, 0.0, 0.0, 0.7618, 0.256303, 0.256471],
        [0.0, 1.0, 0.0, 0.355822, 0.768192, 0.355822],
        [0.0, 0.0, 1.0, 0.357524, 0.3574, 0.768309],
        [16.0, 2.0, 0.5, 0.995274, 0.897983, 0.821542],
        [0.02, 0.4, 0.1, 0.300373, 0.620997, 0.429353],
        [-0.1, 0.2, 0.3, 0.245852, 0.517937, 0.576866],
        [0.003, 0.01, 0.0005, 0.04182, 0.088548, 0.019884],
    ]
)


def linear_samples(n: int = 5000) -> np.ndarray:
    rgb = 2.0 ** generator(0, "color", "linear").uniform(-14, 6, (n, 3))
    rgb[: n // 50, 0] *= -1
    return rgb


def test_agx_agrees_with_the_published_configuration():
    assert np.abs(color.agx(PUBLISHED[:, :3]) - PUBLISHED[:, 3:]).max() < 4e-6


def test_agx_inset_is_the_primaries_compressed_by_a_fifth():
    """The derivation its author published: scale the primaries' distance from white by 1 / (1 - 0.2)."""
    srgb = colour.RGB_COLOURSPACES["sRGB"]
    inset = srgb.copy()
    inset.primaries = (srgb.primaries - srgb.whitepoint) / (1 - 0.2) + srgb.whitepoint
    inset.use_derived_transformation_matrices(True)
    derived = colour.matrix_RGB_to_RGB(srgb, inset)
    assert np.abs(np.array(color.AGX_INSET) - derived).max() < 2e-4  # 4-digit sRGB matrices in the original


def test_agx_before_its_curve_agrees_with_opencolorio():
    """Matrix and log2 allocation by OpenColorIO; the curve is undone on our side by its own table."""
    group = ocio.GroupTransform(
        [
            ocio.RangeTransform(minInValue=0, minOutValue=0),
            ocio.MatrixTransform(np.pad(color.AGX_INSET, (0, 1)).ravel() + np.diag([0, 0, 0, 1]).ravel()),
            ocio.AllocationTransform(allocation=ocio.ALLOCATION_LG2, vars=list(color.AGX_LOG2_RANGE)),
        ]
    )
    processor = ocio.Config.CreateRaw().getProcessor(group).getDefaultCPUProcessor()
    encoded = linear_samples().astype(np.float32)
    linear = encoded.astype(np.float64)
    processor.applyRGB(encoded)
    table = np.linspace(0, 1, 20001)
    curve = color._agx_sigmoid(np, table)
    inside = (encoded > 0.01) & (encoded < 0.97)  # where the curve is steep enough to be undone
    undone = np.interp(color.agx(linear), curve, table)
    assert inside.mean() > 0.5
    assert np.abs(undone - encoded)[inside].max() < 1e-4


def test_agx_curve_meets_its_ends_and_pivot_and_never_falls():
    x = np.linspace(0, 1, 10001)
    y = color._agx_sigmoid(np, x)
    assert abs(y[0]) < 1e-12
    assert abs(y[-1] - 1) < 1e-12
    assert (np.diff(y) >= 0).all()
    assert np.interp(10 / 16.5, x, y) == pytest.approx(0.5, abs=1e-6)
    assert np.gradient(y, x)[np.abs(x - 10 / 16.5).argmin()] == pytest.approx(2.0, abs=1e-3)


def test_agx_stays_within_the_display_for_any_input():
    display = color.agx(np.array([[-1e30, 0.0, 1e-30], [1e30, 1e30, 1e30], [np.inf, 1.0, 0.0]]))
    assert np.isfinite(display).all()
    assert display.min() >= 0
    assert display.max() <= 1


@pytest.mark.parametrize("function", [color.agx, color.srgb_to_linear, color.linear_to_srgb, color.luminance])
def test_torch_and_numpy_agree_and_keep_their_type(function):
    x = np.abs(linear_samples(500)).astype(np.float32)
    result = function(torch.from_numpy(x))
    assert isinstance(result, torch.Tensor)
    assert result.dtype == torch.float32
    assert function(x).dtype == np.float32
    np.testing.assert_allclose(result.numpy(), function(x), rtol=2e-5, atol=1e-6)


def test_channel_axis_is_free():
    x = linear_samples(12).reshape(3, 4, 3)
    moved = np.moveaxis(x, -1, 0)
    assert (color.agx(moved, axis=0) == np.moveaxis(color.agx(x), -1, 0)).all()
    assert (color.luminance(moved, axis=0) == color.luminance(x)).all()
    with pytest.raises(ValueError, match="3 channels"):
        color.agx(x[..., :2])


@pytest.mark.parametrize("function", [color.agx, color.srgb_to_linear, color.linear_to_srgb])
def test_gradients_are_finite_at_every_corner(function):
    corners = [-1.0, 0.0, 1e-30, 0.0031308, 0.04045, 0.18, 1.0, 100.0]
    x = torch.tensor([[c] * 3 for c in corners], dtype=torch.float64, requires_grad=True)
    function(x).sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


def test_agx_gradient_is_that_of_its_values():
    x = torch.from_numpy(np.abs(linear_samples(40)).clip(1e-3, 10)).requires_grad_()
    assert torch.autograd.gradcheck(color.agx, (x,), eps=1e-7, atol=1e-4)


def test_srgb_agrees_with_colour_science_and_inverts():
    x = np.linspace(0, 1, 4001)
    np.testing.assert_allclose(color.srgb_to_linear(x), colour.models.eotf_sRGB(x), atol=2e-8)
    np.testing.assert_allclose(color.linear_to_srgb(x), colour.models.eotf_inverse_sRGB(x), atol=2e-8)
    np.testing.assert_allclose(color.srgb_to_linear(color.linear_to_srgb(x)), x, atol=1e-7)


def test_luminance_is_the_y_of_colour_science():
    rgb = np.abs(linear_samples(100))
    xyz = rgb @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T
    np.testing.assert_allclose(color.luminance(rgb), xyz[:, 1], rtol=1e-3)
    assert sum(color.LUMINANCE) == pytest.approx(1)


def test_exposure_is_a_factor_on_linear_light():
    x = np.abs(linear_samples(100))
    assert (color.to_display(x, 0.25) == color.agx(0.25 * x)).all()


def test_agx_is_undone_within_its_range():
    x = np.abs(linear_samples(200)).clip(1e-3, 10)
    np.testing.assert_allclose(color.from_agx(color.agx(x)), x, rtol=1e-4)
    assert np.isfinite(color.from_agx(np.array([[0.0, 0.5, 1.0]]))).all()


def test_the_look_of_photographs_keeps_grey_and_turns_the_curve_about_it():
    grey = np.full((3, 3), 0.18) * np.array([[2**-0.01], [1.0], [2**0.01]])
    plain, look = color.agx(grey), color.agx(grey, look="photograph")
    np.testing.assert_allclose(look[1], plain[1], atol=1e-4)
    contrast, saturation = color.LOOKS["photograph"]
    assert (look[2, 0] - look[0, 0]) / (plain[2, 0] - plain[0, 0]) == pytest.approx(contrast, rel=1e-2)
    # Saturation by OpenColorIO's CDL, of a picture without contrast.
    graded = ocio.CDLTransform()
    graded.setSat(saturation)
    processor = ocio.Config.CreateRaw().getProcessor(graded).getDefaultCPUProcessor()
    x = np.abs(linear_samples(50)).astype(np.float32)
    low, high = color.AGX_LOG2_RANGE
    pivot = 0.18 * 2 ** (low + color._AGX_PIVOT[0] * (high - low)) / 0.18
    inset = x @ np.array(color.AGX_INSET).T
    steeper = np.maximum(pivot * (inset / pivot) ** contrast @ np.linalg.inv(np.array(color.AGX_INSET)).T, 0)
    kept = (steeper > 0).all(axis=1)
    expected = np.array([processor.applyRGB(list(pixel)) for pixel in color.agx(steeper[kept])])
    np.testing.assert_allclose(color.agx(x[kept], look="photograph"), expected.clip(0, 1), atol=2e-3)

"""A capture says at the door what is wrong with it, and reads no file before it is asked to."""

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.errors import TronError

CAMERA = Camera.look_at((3, 0, 1), (0, 0, 0), fov_deg=50, width=6, height=4)


def view(name: str = "a", **maps) -> View:
    image = maps.pop("image", np.full((4, 6, 3), 0.5))
    return View(name, CAMERA, image, maps.pop("space", "display"), **maps)


def test_maps_are_float32_and_scalar_maps_lose_their_channel() -> None:
    whole = view(
        roughness=np.full((4, 6, 1), 0.25), sky_mask=np.ones((4, 6), bool), normal=-np.ones((4, 6, 3))
    )
    assert whole.read().dtype == np.float32
    assert whole.read("roughness").shape == (4, 6)
    assert whole.read("sky_mask").dtype == np.float32
    assert not whole.has("irradiance")


def test_a_reader_is_called_when_it_is_asked_and_checked_then() -> None:
    calls = []

    def read() -> np.ndarray:
        calls.append(1)
        return np.full((4, 6, 3), np.nan)

    lazy = view(irradiance=read)
    assert not calls
    with pytest.raises(TronError, match=r"irradiance holds 72 values.*\(view a\)"):
        lazy.read("irradiance")
    assert len(calls) == 1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"image": np.zeros((6, 4, 3))}, "its camera says"),
        ({"image": np.zeros((4, 6))}, "its camera says"),
        ({"image": np.full((4, 6, 3), 1.5)}, "between 0 and 1"),
        ({"space": "srgb"}, "linear or display"),
        ({"roughness": np.full((4, 6), 2.0)}, "between 0 and 1"),
        ({"irradiance": np.full((4, 6, 3), -1.0)}, "between 0 and inf"),
        ({"normal": np.full((4, 6, 3), np.inf)}, "NaN or infinite"),
        ({"name": ""}, "no name"),
    ],
)
def test_wrong_views_are_refused_in_one_line(change: dict, message: str) -> None:
    with pytest.raises(TronError, match=message) as caught:
        view(**change)
    assert "\n" not in str(caught.value)


def test_linear_images_may_exceed_one() -> None:
    assert view(image=np.full((4, 6, 3), 50.0), space="linear").read().max() == 50


def test_a_map_that_is_absent_is_named() -> None:
    with pytest.raises(TronError, match=r"no irradiance map \(view a\)"):
        view().read("irradiance")


@pytest.mark.parametrize(("size", "times"), [((24, 16), 2), ((24, 16), 4), ((25, 18), 2)])
def test_a_reduced_view_shows_the_same_directions(size: tuple[int, int], times: int) -> None:
    """A picture that is linear in the image plane is, at each centre of a larger pixel, what it was there."""

    def shown(camera: Camera) -> np.ndarray:
        local = camera.exact_rays() @ camera.world_to_camera[:3, :3].T
        x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        return np.stack([0.5 + 0.3 * x, 0.5 - 0.2 * y, 0.5 + 0.1 * (x + y)], -1)

    camera = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=50, width=size[0], height=size[1])
    view = View("a", camera, shown(camera), "display", depth=np.ones(size[::-1])).reduced(times)
    assert (view.camera.width, view.camera.height) == tuple(max(round(side / times), 1) for side in size)
    assert not view.has("depth")
    # Pixels that are cut up are as even as one pixel: a small part of a pixel's difference.
    whole = all(side % times == 0 for side in size)
    np.testing.assert_allclose(view.read(), shown(view.camera), atol=1e-6 if whole else 2e-3)


def test_a_reduced_view_believes_whole_pixels_and_has_unit_normals() -> None:
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), fov_deg=40, width=4, height=2, up=(0, 1, 0))
    valid, normal = np.ones((2, 4)), np.zeros((2, 4, 3))
    valid[0, 0] = 0
    normal[:, 0], normal[:, 1] = (0, 0.6, 0.8), (0, -0.6, 0.8)  # they agree on (0, 0, 1)
    normal[0, 2:], normal[1, 2:] = (1, 0, 0), (-1, 0, 0)
    view = View("a", camera, np.zeros((2, 4, 3)), "display", valid=valid, normal=normal).reduced(2)
    assert view.believed().tolist() == [[False, True]]
    np.testing.assert_allclose(view.read("normal"), [[(0, 0, 1), (0, 0, 0)]], atol=1e-6)


def test_a_window_of_a_view_shows_what_the_view_shows_there() -> None:
    camera = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=50, width=24, height=16)
    rays = camera.exact_rays()
    whole = View("a", camera, 0.5 + 0.5 * rays, "display", depth=rays[..., 0] + 2)
    part = whole.window(5, 3, 8, 6)
    assert (part.camera.width, part.camera.height) == (8, 6)
    np.testing.assert_allclose(part.camera.exact_rays(), rays[3:9, 5:13], atol=1e-12)
    np.testing.assert_array_equal(part.read(), whole.read()[3:9, 5:13])
    np.testing.assert_array_equal(part.read("depth"), whole.read("depth")[3:9, 5:13])
    assert not part.has("normal")


def test_views_are_split_by_name() -> None:
    capture = Capture((view("a"), view("b"), view("c")), test=frozenset({"b"}))
    assert [v.name for v in capture.train_views] == ["a", "c"]
    assert [v.name for v in capture.test_views] == ["b"]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"views": ()}, "no views"),
        ({"views": (view("a"), view("a"))}, "2 views of a capture are named 'a'"),
        ({"test": {"z"}}, "'z' is not among"),
        ({"test": {"a"}}, "held out"),
        ({"up": (0, 0, 2)}, "unit vector"),
        ({"points": np.zeros((3, 2))}, r"\(N, 3\)"),
        ({"points": np.full((3, 3), np.nan)}, "finite"),
        ({"points": np.zeros((3, 3)), "point_colors": np.zeros((2, 3))}, "do not match"),
        ({"exposure": 0.0}, "positive"),
    ],
)
def test_wrong_captures_are_refused_in_one_line(change: dict, message: str) -> None:
    with pytest.raises(TronError, match=message) as caught:
        Capture(**{"views": (view("a"),), **change})
    assert "\n" not in str(caught.value)

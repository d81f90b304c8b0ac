"""What views select, against closed forms: rays that meet a ball, its outline, the height of its top."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.stage import BALL, FLOOR, RING
from tron.cameras import Camera
from tron.editing import Clicks, Grown, Selection, Views
from tron.editing.placement import surface_below
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.images import write_image
from tron.seeds import generator

pytestmark = pytest.mark.usefixtures("variant")
CENTRE, RADIUS = np.array([0.1, -0.4, 0.4]), 0.4
SIZE = 64


def seen_from(*eye: float) -> Camera:
    return Camera.look_at(eye, (0, 0, 0.3), fov_deg=40, width=SIZE, height=SIZE)


@pytest.fixture(scope="module")
def views() -> Views:
    cameras = [seen_from(3, -3, 2), seen_from(-3, -3, 1.5), seen_from(0.5, -4, 3)]
    return Views(cameras, ("front.jpg", "left.jpg", "top.jpg"))


def on_ball(camera: Camera, radius: float = RADIUS) -> np.ndarray:
    """(H, W) bool: pixels whose ray passes the ball's centre within a radius."""
    towards = CENTRE - camera.position
    across = np.linalg.norm(np.cross(camera.exact_rays(), towards), axis=-1)
    return across < radius


def without_sign(scene: GaussianScene) -> GaussianScene:
    over = generator(0, "tests", "over").random(len(scene)) < 0.5
    return replace(scene.turned_over(over), oriented=False)


@pytest.mark.parametrize("sign", [lambda scene: scene, without_sign], ids=["signed", "without-sign"])
def test_shares_are_of_the_pixels_that_a_ball_fills(scene, views, sign):
    """Against its outline: 1 well inside, 0 well outside; but where the ring stands before it."""
    shown, camera = sign(scene), views["front.jpg"]
    ball, ring = scene.object_id == BALL, scene.object_id == RING
    share, hidden = views.shares(shown, ball, camera), views.shares(shown, ring, camera) > 0.01
    assert share[on_ball(camera, 0.85 * RADIUS) & ~hidden].min() > 0.9
    assert share[~on_ball(camera, 1.2 * RADIUS)].max() < 0.02
    both = views.shares(shown, np.ones(len(scene), bool), camera)
    np.testing.assert_allclose(share + views.shares(shown, ~ball, camera), both, atol=1e-5)


@pytest.mark.parametrize("sign", [lambda scene: scene, without_sign], ids=["signed", "without-sign"])
def test_a_pixel_picks_what_its_ray_meets(scene, views, sign):
    """On the ball: surfels of it, no further from the first root of the quadratic than two spacings."""
    shown, camera = sign(scene), views["front.jpg"]
    inner = np.argwhere(on_ball(camera, 0.7 * RADIUS))
    for y, x in inner[:: len(inner) // 5].tolist():
        picked = views.picked(shown, "front.jpg", (x + 0.2, y + 0.7))
        direction = camera.exact_rays()[y, x]
        along = direction @ (CENTRE - camera.position)
        gap = RADIUS**2 - (CENTRE - camera.position) @ (CENTRE - camera.position) + along**2
        assert gap > 0, "the pixel is on the ball"
        point = camera.position + (along - np.sqrt(gap)) * direction
        assert len(picked)
        assert (scene.object_id[picked] == BALL).all()
        assert np.linalg.norm(scene.means[picked] - point, axis=1).max() < 4 * scene.spacing


def test_clicks_in_views_part_the_ball_from_the_rest(scene, views):
    """Pixels of each thing by projecting the middles of its faces."""

    def pixel(camera: Camera, point: np.ndarray) -> tuple[float, float]:
        ((x, y),), _ = camera.project(point[None])
        return float(x), float(y)

    front = views[0]
    up, side = CENTRE + np.array([0, 0, RADIUS]), CENTRE + RADIUS * np.array([1, -1, 0]) / np.sqrt(2)
    outside = pixel(front, np.array([1.2, 1.0, 0.0])), pixel(front, np.array([1.0, -1.2, 0.0]))
    ring = pixel(views[2], np.array([-0.1, 0.5, 0.5]) + 0.37 * np.array([0, 0, 1.0]) + [0, -0.07, 0.11])
    clicks = (
        Clicks(view=0, inside=(pixel(front, up), pixel(front, side)), outside=outside),
        Clicks(view="top.jpg", outside=(ring,)),
    )
    selected = Selection(clicks=clicks).of(scene, views)
    np.testing.assert_array_equal(selected, scene.object_id == BALL)
    grown = Selection(grow=Grown(view="0", at=(pixel(front, up),), color=0.2)).of(scene, views)
    np.testing.assert_array_equal(grown, scene.object_id == BALL)


def test_masks_are_lifted_by_the_vote_of_the_views_that_see(scene, views, tmp_path: Path):
    """The ball's outline in three views selects what they see of the ball, and next to nothing else."""
    masks = {}
    for name, camera in zip(views.names, views.cameras):
        masks[name] = tmp_path / f"{name}.png"
        write_image(masks[name], on_ball(camera).astype(np.float32)[..., None])
    selected = Selection(masks=masks).of(scene, views)
    ball = scene.object_id == BALL
    facing = np.stack([~scene.looks_away(camera.position) for camera in views.cameras])
    steep = np.stack(
        [
            np.einsum("mi,mi->m", scene.normals(), camera.position - scene.means)
            > 0.3 * np.linalg.norm(camera.position - scene.means, axis=1)
            for camera in views.cameras
        ]
    )
    wanted = ball & (facing & steep).any(0)
    assert selected[wanted].mean() > 0.97
    assert (selected & ~ball).sum() < 0.02 * ball.sum()
    unseen = ball & ~facing.any(0) & (scene.means[:, 2] < 0.1)
    assert unseen.any()
    assert not selected[unseen].any(), "what no view sees is not selected"


def test_one_wrong_mask_of_three_is_outvoted(scene, views, tmp_path: Path):
    every = {}
    for name, camera in zip(views.names, views.cameras):
        every[name] = tmp_path / f"{name}.png"
        write_image(every[name], on_ball(camera).astype(np.float32)[..., None])
    right = views.lifted(scene, every)
    write_image(every["left.jpg"], np.ones((SIZE, SIZE, 1), np.float32))
    wrong = views.lifted(scene, every)
    alone = views.lifted(scene, {"left.jpg": every["left.jpg"]})
    floor = scene.object_id == FLOOR
    assert (alone & floor).sum() > 0.6 * floor.sum()
    assert (wrong & floor).sum() < 0.25 * floor.sum()
    assert (wrong & right).sum() > 0.97 * right.sum()


def test_what_lies_below_a_point_is_found(scene, views):
    for (x, y), height in {(0.1, -0.4): 0.8, (0.3, -0.4): 0.4 + np.sqrt(0.12), (1.1, 0.9): 0.0}.items():
        found = surface_below(scene, views, np.array([x, y, 3.0]))
        np.testing.assert_allclose(found, [x, y, height], atol=0.01)
    with pytest.raises(TronError, match="nothing lies below"):
        surface_below(scene, views, np.array([9.0, 0, 3]))


def test_behind_half_a_layer_one_of_both_is_met(dense_surfels):
    """A sheet that stops about half of all rays hangs one unit above another: never what lies between."""
    floor = dense_surfels.plane(half=0.5)
    scene = dense_surfels.scene(floor, replace(floor, points=floor.points + np.array([0, 0, 1])))
    upper = scene.means[:, 2] > 0.5
    scene = replace(scene, opacity_logits=np.where(upper, np.float32(-1.3), scene.opacity_logits))
    heights = []
    for seed in range(12):
        heights.append(surface_below(scene, Views(seed=seed), np.array([0.01, 0.02, 3.0]))[2])
    assert {round(height) for height in heights} == {0, 1}, "both are met"
    np.testing.assert_allclose(heights, np.round(heights), atol=1e-3)


@pytest.mark.parametrize(
    ("pick", "said"),
    [
        (lambda views, scene, _: views.picked(scene, "back.jpg", (3, 3)), "there is no view back.jpg"),
        (lambda views, scene, _: views.picked(scene, 3, (3, 3)), "views are 0..2, or front.jpg"),
        (lambda views, scene, _: views.picked(scene, 0, (64, 3)), "outside view 0: it has 64 x 64 pixels"),
        (lambda views, scene, _: views.picked(scene, 1, (32, 0)), "shows nothing"),
        (lambda views, scene, mask: views.lifted(scene, {"0": mask}), "the mask has 32 x 16 pixels"),
        (lambda views, scene, mask: views.lifted(scene, {"0": mask.with_name("absent.png")}), "absent.png"),
    ],
)
def test_what_no_view_shows_is_refused(scene, views, tmp_path: Path, pick: Callable, said: str):
    mask = tmp_path / "mask.png"
    write_image(mask, np.ones((16, 32, 1), np.float32))
    with pytest.raises(TronError, match=said):
        pick(views, scene, mask)


def test_picks_repeat_and_masks_of_another_size_are_taken(scene, views, tmp_path: Path):
    again = Views(views.cameras, views.names)
    np.testing.assert_array_equal(views.picked(scene, 0, (36, 40)), again.picked(scene, 0, (36, 40)))
    small, large = tmp_path / "small.png", tmp_path / "large.png"
    outline = on_ball(views[0]).astype(np.float32)[..., None]
    write_image(small, outline)
    write_image(large, outline.repeat(2, 0).repeat(2, 1))
    one, other = (views.lifted(scene, {"front.jpg": path}) for path in (small, large))
    assert (one & other).sum() > 0.9 * (one | other).sum()
    assert RING not in scene.object_id[one & other]

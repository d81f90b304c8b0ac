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


def test_behind_a_thin_layer_one_of_both_is_met(dense_surfels):
    """A sheet hangs one unit above another: never what lies between."""
    floor = dense_surfels.plane(half=0.5)
    scene = dense_surfels.scene(floor, replace(floor, points=floor.points + np.array([0, 0, 1])))
    upper, heights = scene.means[:, 2] > 0.5, []
    for logit in np.linspace(-4, 2, 12):
        logits = np.where(upper, np.float32(logit), scene.opacity_logits)
        sheet = replace(scene, opacity_logits=logits)
        heights.append(surface_below(sheet, Views(), np.array([0.01, 0.02, 3.0]))[2])
    assert [round(height) for height in heights] == sorted(round(height) for height in heights)
    assert {round(height) for height in heights} == {0, 1}, "both are met"
    np.testing.assert_allclose(heights, np.round(heights), atol=1e-3)


def scan_of_strings(count: int = 300) -> tuple[GaussianScene, Camera]:
    """Flat splats in a row that a camera sees edge on, before a wall; as disks they cover nothing."""
    across, quarter = np.linspace(-1, 1, count), np.sqrt(0.5)
    strings = np.stack([across, np.zeros(count), np.zeros(count)], axis=1)
    x, z = (each.ravel() for each in np.meshgrid(*[np.linspace(-1.5, 1.5, 40)] * 2))
    means = np.concatenate([strings, np.stack([x, np.full_like(x, 1.0), z], axis=1)])
    flat, upright = np.array([1.0, 0, 0, 0]), np.array([quarter, quarter, 0, 0])
    thin, number = np.arange(len(means)) < count, len(means)
    scene = GaussianScene(
        means=means.astype(np.float32),
        quats=np.where(thin[:, None], flat, upright).astype(np.float32),
        log_scales=np.log(np.where(thin, 0.01, 0.05))[:, None].repeat(2, 1).astype(np.float32),
        opacity_logits=np.full(number, 4, np.float32),
        sh=np.zeros((number, 16, 3), np.float32),
        base_color=np.full((number, 3), 0.5, np.float32),
        roughness=np.full(number, 0.5, np.float32),
        metallic=np.zeros(number, np.float32),
        object_id=np.where(thin, 1, 2).astype(np.int32),
        oriented=False, projection="3dgs", spacing=0.05,
    )  # fmt: skip
    scene.validate()
    return scene, Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=40, width=64, height=48)


def test_what_a_pixel_shows_of_a_scan_is_what_is_picked():
    """A string that no ray through disks meets: the picture shows it, so clicks on it are on it."""
    scene, camera = scan_of_strings()
    views = Views([camera])
    on_string = views.shares(scene, scene.object_id == 1, camera)
    y = int(on_string[:, 32].argmax())
    for x in (20, 32, 41):
        assert on_string[y, x] > 0.7
        picked, point = views.shown(scene, camera, x, y)
        assert (scene.object_id[picked] == 1).all()
        pixels, _ = camera.project(scene.means[picked])
        assert np.abs(pixels - (x + 0.5, y + 0.5)).max() < 3
        np.testing.assert_allclose(camera.project(point[None])[0][0], (x + 0.5, y + 0.5), atol=1e-3)
        assert abs(point[1]) < 0.1, "on the string, not on the wall"
        disks = Views([camera]).shown(replace(scene, projection="disks"), camera, x, y)
        assert (scene.object_id[disks[0]] == 2).all()


@pytest.mark.parametrize("size", [(64, 48), (40, 56)])
@pytest.mark.parametrize("projection", ["3dgs", "disks"])
def test_picked_surfels_are_most_of_what_the_pixel_shows(size, projection):
    """By the picture's own compositing of them; one layer is hit."""
    scene, camera = scan_of_strings()
    scene = replace(scene, projection=projection)
    camera = replace(camera, width=size[0], height=size[1])
    views = Views([camera])
    for x, y in ((10, 9), (30, 12), (33, 40)):
        which = np.isin(np.arange(len(scene)), views.picked(scene, 0, (x, y)))
        assert 0 < which.sum() < 30
        share, whole = (views.shares(scene, each, camera)[y, x] for each in (which, which | True))
        assert share > 0.94 * whole


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

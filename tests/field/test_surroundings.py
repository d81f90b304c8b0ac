"""Scenes with and without surroundings that shut out the light: each kind is told, and treated as asked."""

import numpy as np
import pytest

from tron.apps.reconstruct.settings import SplatSettings
from tron.apps.reconstruct.splat_capture import film_splats
from tron.cameras import Camera
from tron.estimation import Estimation
from tron.framing import even_directions
from tron.gaussians import GaussianScene
from tron.gaussians.edit import subset
from tron.gaussians.harmonics import rgb_to_dc
from tron.gaussians.scene import quats_from_normals
from tron.reconstruction.settings import FusionSettings
from tron.relighting import EnvironmentMap, Relighter
from tron.scans.surroundings import treat_surroundings
from tron.seeds import generator
from tron.tracing.surroundings import find_surroundings

pytestmark = pytest.mark.usefixtures("variant")
RNG = generator(1, "surroundings")
UP = np.array([0.0, 0.0, 1.0])


def splats(points, normals, size, color=(0.5, 0.5, 0.5)):
    """Means, normals, sizes and colours of a part of a scene."""
    points = np.asarray(points, float)
    shape = points.shape
    return points, np.broadcast_to(normals, shape), np.full(len(points), size), np.broadcast_to(color, shape)


def scene_of(*parts, **fields):
    means, normals, size, color = (np.concatenate(arrays) for arrays in zip(*parts))
    count = len(means)
    sh = np.zeros((count, 16, 3))
    sh[:, 0] = rgb_to_dc(color)
    return GaussianScene(
        means=means, quats=quats_from_normals(normals), log_scales=np.log(np.tile(size[:, None], 2)),
        opacity_logits=np.full(count, 5.0), sh=sh, base_color=color, roughness=np.full(count, 0.7),
        metallic=np.zeros(count), object_id=np.zeros(count), spacing=0.05, up=UP, oriented=False, **fields,
    ).validate()  # fmt: skip


def ball(radius=0.5, count=1500, centre=(0, 0, 0.5)):
    out = even_directions(count)
    return splats(centre + radius * out, out, 2.5 * radius / np.sqrt(count), (0.8, 0.1, 0.1))


def sheet(corner, u, v, size=0.08):
    """A rectangle from a corner along two edges, its splats as far apart as they are large."""
    u, v = np.asarray(u, float), np.asarray(v, float)
    sides = [np.arange(0, np.linalg.norm(edge), 1.5 * size) / np.linalg.norm(edge) for edge in (u, v)]
    a, b = (each.reshape(-1, 1) for each in np.meshgrid(*sides))
    normal = np.cross(u, v)
    return splats(corner + a * u + b * v, normal / np.linalg.norm(normal), size)


def ground(half=2.0, size=0.08):
    return sheet((-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), size)


def shell(radius, count=60, low=-1.0, high=1.0, size=None, squash=(1, 1, 1), kept=1.0):
    out = even_directions(count)
    out = out[(out[:, 2] >= low) & (out[:, 2] <= high) & (RNG.random(count) < kept)]
    size = 3.0 * radius / np.sqrt(count) if size is None else size
    return splats(radius * out * squash, out, size, (0.5, 0.7, 1.0))


def box(side, height, size=0.08, roof=True):
    """Walls and a floor, seen from within."""
    low, high = -side / 2, side / 2
    walls = [
        sheet((low, low, 0), (side, 0, 0), (0, 0, height), size),
        sheet((low, high, 0), (side, 0, 0), (0, 0, height), size),
        sheet((low, low, 0), (0, side, 0), (0, 0, height), size),
        sheet((high, low, 0), (0, side, 0), (0, 0, height), size),
    ]
    return walls + ([sheet((low, low, height), (side, 0, 0), (0, side, 0), size)] if roof else [])


def far_ground(reach=60):
    """A ground to the horizon, of few and ever larger splats."""
    radius = np.geomspace(2, reach, 200)
    turn = np.pi * (3 - 5**0.5) * np.arange(200)
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], 1)
    points, normals, _, color = splats(points, UP, 1)
    return points, normals, 0.3 * radius, color


SUBJECT = [ball(), ground()]
HILLS = shell(12, 500, low=0.0, high=0.4, size=0.8)
STRAYS = splats(RNG.normal(size=(20, 3)) * 6, UP, 0.05)

SURROUNDED = {
    "a sphere of one per cent": [shell(30, 60)],
    "a dome, from the horizon up": [shell(30, 120, low=0.0)],
    "a dome with holes": [shell(20, 400, low=0.0, kept=0.75)],
    "a third of all splats": [shell(25, 2000)],
    "near, four times the ground's size": [shell(12, 300)],
    "two layers": [shell(20, 80), shell(40, 80)],
    "flattened": [shell(40, 200, squash=(1, 1, 0.5))],
    "around strays": [STRAYS, shell(40, 120)],
    "around hills": [HILLS, shell(60, 200)],
    "around a wide ground": [far_ground(15), shell(60, 200)],
}
OWN = {
    "around strays": 20,
    "around hills": len(HILLS[0]),
    "around a wide ground": 200,
}
"""Splats that are neither the subject's nor the shell's, which come behind the subject's."""

CONTENT = {
    "a thing and its floor": SUBJECT,
    "a room": [ball(0.4), ground(2.0), *box(4, 2.6)],
    "a room of large splats, a thing of small ones": [ball(0.3, 8000), ground(3, 0.2), *box(6, 3, 0.2)],
    "a hall": [ball(0.5, 4000), ground(8, 0.2), *box(16, 8, 0.3)],
    "a courtyard": [ball(0.5), ground(4, 0.15), *box(8, 6, 0.15, roof=False)],
    "a long street": [ball(0.8), sheet((-30, -4, 0), (60, 0, 0), (0, 8, 0), 0.2),
                      sheet((-30, -4, 0), (60, 0, 0), (0, 0, 9), 0.2),
                      sheet((-30, 4, 0), (60, 0, 0), (0, 0, 9), 0.2)],
    "a tall room, a thing of small splats": [ball(0.3, 8000), ground(2, 0.15), *box(4, 5, 0.25)],
    "a hall of few splats": [ball(0.5, 20000), ground(8, 0.3), *box(16, 8, 0.5)],
    "a thing on a far ground": [*SUBJECT, far_ground()],
    "a fine disc in a hall": [ball(0.25, 8000), ground(0.6, 0.02), ground(2.5, 0.1), *box(5, 3, 0.3)],
    "a roofless court": [ball(0.25, 8000), ground(0.6, 0.02), ground(5, 0.1), *box(10, 10, 0.3, roof=False)],
    "hills all around": [*SUBJECT, HILLS],
    "strays": [*SUBJECT, STRAYS],
    "a wall of sky behind": [*SUBJECT, sheet((-20, 25, -5), (40, 0, 0), (0, 0, 30), 2.0)],
}  # fmt: skip


@pytest.mark.parametrize("kind", SURROUNDED)
def test_a_shell_that_shuts_out_the_light_is_found(kind):
    scene = scene_of(*SUBJECT, *SURROUNDED[kind])
    inside = sum(len(part[0]) for part in SUBJECT) + OWN.get(kind, 0)
    found = find_surroundings(scene)
    assert not found[:inside].any()
    assert found[inside:].all()


@pytest.mark.parametrize("kind", CONTENT)
def test_rooms_hills_and_strays_are_content(kind):
    assert not find_surroundings(scene_of(*CONTENT[kind])).any()


def test_which_way_is_up_decides_nothing_about_a_sphere():
    scene = scene_of(*SUBJECT, shell(30, 60))
    for up in np.vstack([np.eye(3), -np.eye(3)]):
        scene.up = up
        assert find_surroundings(scene).sum() == 60


@pytest.mark.parametrize(
    "name, least", [("field/sky-dome/dome.ply", 60), ("splats/biker.ply", 0), ("splats/guitar.ply", 0)]
)
def test_real_files(shared_data, name, least):
    path = shared_data / name
    assert find_surroundings(GaussianScene.load(path)).sum() == least


@pytest.fixture(scope="module")
def domed():
    return scene_of(*SUBJECT, shell(30, 300))


def lit(surrounded, camera):
    estimation = Estimation(rays=32, bounces=1)
    relighter = Relighter(surrounded.shown, estimation, backdrop=surrounded.backdrop)
    return relighter.under(EnvironmentMap(np.full((16, 32, 3), 0.7, np.float32))).render(camera)


@pytest.mark.parametrize(
    "position",
    [pytest.param((3, -3, 3), marks=pytest.mark.long), pytest.param((40, -40, 30), marks=pytest.mark.long)],
    ids=["inside", "outside"],
)
def test_what_surrounds_is_in_no_light_s_way(domed, position, tmp_path):
    camera = Camera.look_at(position, (0, 0, 0.4), fov_deg=50 if position[0] < 9 else 5, width=32, height=32)
    alone = lit(treat_surroundings(scene_of(*SUBJECT), "drop", tmp_path), camera)
    dropped = lit(treat_surroundings(domed, "drop", tmp_path), camera)
    behind = lit(treat_surroundings(domed, "background", tmp_path), camera)
    kept = lit(treat_surroundings(domed, "keep", tmp_path), camera)
    thing = alone.mask > 0.99
    # Proxies of the two are filmed from cameras that differ by a hair: a rim pixel may be another.
    assert np.quantile(abs(dropped.irradiance - alone.irradiance), 0.99) < 0.03
    assert abs(behind.irradiance[thing] - alone.irradiance[thing]).mean() < 0.02
    assert abs(behind.lit[thing] - alone.lit[thing]).mean() < 0.02
    outside = position[0] > 9
    assert outside or kept.irradiance[thing].mean() < 0.2 * alone.irradiance[thing].mean()
    empty = alone.mask < 0.01
    np.testing.assert_allclose(dropped.lit[empty], 0.7, atol=1e-3)  # the new light's sky
    assert behind.mask[empty].mean() > 0.95  # the scan's own


@pytest.mark.parametrize("treatment", ["drop", "background"])
def test_a_line_says_what_was_found_and_what_to_do(domed, treatment, tmp_path, caplog):
    treated = treat_surroundings(domed, treatment, tmp_path / "scan.ply")
    assert "scan.ply: 300 of" in caplog.text
    assert "surroundings=keep" in caplog.text or treatment == "background"
    assert len(treated.content) == len(domed) - 300


def test_a_scan_without_surroundings_says_nothing(tmp_path, caplog):
    treat_surroundings(scene_of(*SUBJECT), "drop", tmp_path)
    assert not caplog.text


@pytest.mark.parametrize("treatment", ["drop", "background"])
def test_splats_are_filmed_without_their_sky_or_with_it_as_sky(domed, treatment, tmp_path):
    domed.save(tmp_path / "scan.ply")
    settings = SplatSettings(views=4, side=32, surroundings=treatment)
    capture = film_splats(
        tmp_path / "scan.ply", settings, (0, 0, 1), 0, FusionSettings(), 0, lambda rays, _: rays
    )
    assert (capture.views[0].read("mask") < 0.5).mean() > 0.05
    for view in capture.views:
        assert np.linalg.norm(view.camera.position) < 10
        assert (view.read("mask") > 0.5).mean() > 0.05
        assert view.has("sky_mask") == (treatment == "background")
        if view.has("sky_mask"):
            both = view.read("mask") + view.read("sky_mask")
            assert both.min() > 0.9
            assert both.max() < 1.01


def test_a_part_of_a_scene_has_its_own_spacing(domed):
    part = subset(domed, np.arange(1500))
    assert len(part) == 1500
    assert part.spacing != domed.spacing

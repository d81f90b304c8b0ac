"""The mesh peer on a small world whose true meshes, materials and light are known; Mitsuba is the witness."""

from dataclasses import replace

import numpy as np
import pytest

from eval.applications.worlds import World, draw_world
from eval.cli import cli, main
from eval.methods.mesh_fit import MeshFit, MeshSettings, fit_mesh, lit_frames, plain_mesh
from eval.protocol.method import MethodFolder
from eval.protocol.suite import MapName, NewScene, write_suite
from eval.results import Results
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.color import to_display
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.metrics import capped_psnr
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.long
SIDE, SEED = 40, 5
TINY = MeshSettings(voxels=96, light_height=8, steps=60, spp=4, frame_spp=16, color_rate=0.05, light_rate=0.1)


def around(count: int, width: int = SIDE, high: float = 2.2) -> list[Camera]:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [(3.4 * np.cos(a), 3.4 * np.sin(a), high) for a in angles]
    return [Camera.look_at(eye, (0, 0.1, 0.2), fov_deg=46, width=width, height=width) for eye in eyes]


def photographed() -> list[Camera]:
    return [*around(12), *around(12, high=0.9), *around(4, high=3.4)]


@pytest.fixture(scope="module")
def world(variant: str) -> World:
    """Of two colours, so that grey is wrong everywhere."""
    plain = draw_world(SEED, "mesh peer", 0, "soft", things=2)
    red, green = [0.7, 0.15, 0.1], [0.15, 0.5, 0.3]
    parts = [replace(part, base_color=np.where(part.vertices[:, :1] < 0, red, green)) for part in plain.parts]
    return replace(plain, parts=tuple(parts))


@pytest.fixture(scope="module")
def capture(world: World) -> Capture:
    views = []
    for number, camera in enumerate(photographed()):
        image = world.traced(camera, 64, integer(SEED, "test photo", number))
        mask = (world.surface(camera).depth[..., 0] > 0).astype(np.float32)
        views.append(View(f"v{number:02d}", camera, image, "linear", mask=mask))
    return Capture(tuple(views), exposure=float(0.5 / np.mean([view.read().mean() for view in views])))


@pytest.fixture(scope="module")
def surfels(world: World) -> GaussianScene:
    """True places, and grey: no colour of theirs helps the fit."""
    scene = world.surfels(15_000)
    return replace(scene, sh=np.zeros_like(scene.sh))


@pytest.fixture(scope="module")
def peer(surfels: GaussianScene, capture: Capture) -> MeshFit:
    return fit_mesh(capture, surfels, TINY, SEED, lambda some, _: some)


def relit(mesh, world: World, light: EnvironmentMap) -> float:
    """PSNR of views that nobody learnt from under another light, after the one factor that photos leave."""
    cameras, lit = around(3, high=1.6), replace(world, light=light)
    truth = np.stack([lit.traced(camera, 64, 7 + number) for number, camera in enumerate(cameras)])
    shown = np.stack([*lit_frames(mesh, cameras, light, TINY.frame_spp, range(3))])
    inside = np.stack([world.surface(camera).depth[..., 0] > 0 for camera in cameras])
    exposure = 0.5 / truth[inside].mean()
    factor = np.median(truth[inside].mean(-1) / np.maximum(shown[inside].mean(-1), 1e-6))
    return capped_psnr(to_display(factor * shown, exposure), to_display(truth, exposure), inside)


def test_what_is_fitted_relights_better_than_a_grey_mesh(peer, world, capture, surfels):
    """Under a sun that no photo saw."""
    light = draw_world(SEED, "mesh peer", 1, "sun", things=2).light
    plain = plain_mesh(capture, surfels, TINY, lambda some, _: some)
    fitted, before = relit(peer.mesh, world, light), relit(plain, world, light)
    print(f"{before:.2f} dB before, {fitted:.2f} dB after")
    assert fitted > before + 2


def test_the_fit_explains_the_photos(peer, world, capture):
    """Under its own light the mesh looks as the photos do."""
    cameras = capture.train_cameras[:3]
    shown = np.stack([*lit_frames(peer.mesh, cameras, peer.light, 16, range(3))])
    photos = np.stack([view.read() for view in capture.views[:3]])
    inside = np.stack([view.read("mask") > 0.5 for view in capture.views[:3]])
    found = capped_psnr(to_display(shown, 1), to_display(photos, capture.exposure), inside)
    print(f"photos: {found:.2f} dB")
    assert found > 24
    assert np.mean(peer.losses[-12:]) < 0.7 * np.mean(peer.losses[:12])


def test_the_same_seed_gives_the_same_mesh(surfels, capture):
    """But for the order in which threads add up gradients, which a step of Adam can make large."""
    settings = TINY.model_copy(update={"steps": 2})
    once, again, other = (
        fit_mesh(capture, surfels, settings, seed, lambda s, _: s).mesh.base_color for seed in (1, 1, 2)
    )
    assert np.abs(once - again).mean() < 1e-3
    assert np.abs(once - other).mean() > 1e-2


def test_photos_that_show_nothing_are_one_line(surfels, capture):
    black = [replace(view, mask=np.zeros((SIDE, SIDE), np.float32)) for view in capture.views]
    settings = TINY.model_copy(update={"steps": 1})
    with pytest.raises(TronError, match="no training photo shows a surface"):
        fit_mesh(replace(capture, views=tuple(black)), surfels, settings, 0, lambda s, _: s)


def test_a_suite_is_shown_by_the_mesh_peer_and_judged_like_anyone(world, tmp_path):
    """From photos to judged pictures; the true maps beside the photos are not looked at."""
    views, zero = [], np.zeros((SIDE, SIDE), np.float32)
    for number, camera in enumerate(photographed()):
        image = to_display(world.traced(camera, 64, integer(SEED, "suite photo", number)), 0.4)
        wrong = {"depth": zero + 9, "normal": np.stack([zero, zero, zero + 1], -1)}  # what truth is not
        mask = (world.surface(camera).depth[..., 0] > 0).astype(np.float32)
        views.append(View(f"v{number:02d}", camera, image, "display", mask=mask, **wrong))
    capture = Capture(tuple(views), exposure=0.4, tone_curve="agx")
    cameras, sun = around(2, high=1.6), draw_world(SEED, "mesh peer", 1, "sun", things=2).light
    truth = np.stack(
        [replace(world, light=sun).traced(camera, 64, 3 + k) for k, camera in enumerate(cameras)]
    )
    seen = [world.surface(camera) for camera in cameras]
    maps: dict[MapName, np.ndarray] = {
        "mask": np.stack([(each.depth[..., 0] > 0).astype(np.float32) for each in seen]),
        "albedo": np.stack([each.base_color for each in seen]),
        "normals": np.stack([each.normal for each in seen]),
    }
    lights = {"1_sun": (sun, sun.exposure(), "sun", truth)}
    scene = NewScene(
        "world", "object", lambda path: write_capture(path, capture), None, cameras, lights, maps
    )
    suite, out = write_suite(tmp_path / "suite", "worlds", [scene]), tmp_path / "methods"
    tiny = ["method.mesh={voxels: 64, light_height: 8, steps: 30, spp: 4, frame_spp: 16}"]
    tiny += ["method.surfels={steps_scaler: 0.01, initial: {count: 3000}}"]
    main(cli.compose("method=mesh_peer", f"suite={suite.folder}", *tiny, f"output_dir={out}"))
    judged = ["benchmark=compare", f"suite={suite.folder}", f"methods={out}"]
    main(cli.compose(*judged, f"output_dir={tmp_path / 'judged'}"))
    rows = {row.metric: row.value for row in Results.load(tmp_path / "judged/results.json").rows}
    print({name: value for name, value in rows.items() if name.startswith("mesh_peer")})
    assert rows["mesh_peer.faults"] == 0
    assert rows["mesh_peer.psnr"] > 15
    told = MethodFolder.load(out / "mesh_peer", suite).method
    assert told.saw == ["photos", "masks"]
    assert (told.seconds.fit or 0) > 0

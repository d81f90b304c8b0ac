"""The tracing benchmark at toy sizes: its rows, its two scenes, its peers, its yardsticks."""

import json
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.results import Results
from eval.timing import Timed, Times, format_count, interleaved
from eval.tracing import accuracy, furnace, hard_cases, peers, scene
from eval.tracing.benchmark import Tracing
from eval.tracing.furnace import Material
from eval.tracing.peers import Contenders
from eval.tracing.scene import Box, Floor, Sphere, Surface, Torus
from eval.tracing.speed import shadow_rows
from tron import metrics, seeds
from tron.cameras import Camera
from tron.tracing import reference

pytestmark = pytest.mark.usefixtures("variant")

TOY = {
    "surfels": "[300,400]",
    "pixels": "[32,64]",
    "shadow_rays": "500",
    "shadow_spp": "2",
    "gradient": "[[300,32]]",
    "irradiance": "[300,32]",
    "bounce": "[[300,32]]",
    "error_rays": "50",
    "rounds": "1",
}
ROWS = [
    "primary.ratio_to_volprim.400_32",
    "primary.ratio_to_volprim_as_shipped.400_32",
    "primary.mrays.400_64",
    "primary.ratio_to_embree_closest_hit.400_32",
    "primary.binning_ms.400_32",
    "shadow.ratio_to_embree_restart.300",
    "shadow.ratio_to_embree_closest_hit.300",
    "shadow.ratio_to_embree_any_hit.300",
    "shadow.ratio_to_embree_any_hit_random.300",
    "bvh.build_ms.300",
    "gradient.ratio_to_volprim.300_32",
    "gradient.cosine_with_volprim.300_32",
    "irradiance.seconds_ratio_to_mitsuba_direct.300_32",
    "irradiance.seconds_ratio_to_mitsuba_direct_sun.300_32",
    "irradiance.seconds_64spp.300_32",
    "primary.max_error",
    "primary.rays_at_a_threshold",
    "shadow.max_error",
    "bounce.seconds_ratio_to_frame.300_32",
    "bounce.lit_frame_ratio.300_32",
    "bounce.transport_seconds.300_32",
    "relighter.overhead.300_32",
    "thin_shadow.deep",
    "sheet.ratio.sun_0.3",
    "furnace.worst.bake",
    "furnace.truth.100_0_20",
    "furnace.seconds_ratio",
]


ARRAYS = (
    "means",
    "quats",
    "log_scales",
    "opacity_logits",
    "sh",
    "base_color",
    "roughness",
    "metallic",
    "object_id",
)


@pytest.mark.long
def test_the_whole_benchmark_runs_and_every_promised_row_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    quick = {"PATHS": 4, "REFERENCE": 16, "RAYS": (2,), "TRIALS": 1, "HEIGHTS": (0.3,), "VIEWS": (30.0,)}
    for name, value in (quick | {"SUNS": ((15.0, 0.0),)}).items():
        monkeypatch.setattr(hard_cases, name, value)
    monkeypatch.setattr(furnace, "MATERIALS", [Material(1.0, 0.0, 0.2), Material(0.5, 1.0, 0.7)])
    monkeypatch.setattr(furnace, "price", partial(furnace.price, side=16, paths=1))
    with pytest.raises(SystemExit) as end:
        cli(
            [
                "benchmark=tracing",
                f"output_dir={tmp_path}",
                *(f"benchmark.{key}={value}" for key, value in TOY.items()),
            ]
        )
    assert end.value.code == 0
    results = Results.load(tmp_path / "results.json")
    found = {row.metric for row in results.rows}
    assert set(ROWS) <= found
    assert results.environment["variant"] != "none"
    error = results.value("primary.max_error")
    assert error is not None
    assert error < 1e-4
    assert len(json.loads((tmp_path / "times.json").read_text())["camera 300_32"]["tron"]) == 1
    page = (tmp_path / "report.html").read_text()
    for anchor in (
        "camera",
        "growth",
        "shadow",
        "gradient",
        "irradiance",
        "guidance",
        "exactness",
        "bounce",
        "furnace",
    ):
        assert f'id="{anchor}"' in page
    assert "blender_python is not given" in results.absent["furnace.cycles_worst"]
    assert (tmp_path / "pictures" / "camera.png").stat().st_size > 0


def test_a_part_alone_gives_its_rows_alone(tmp_path: Path):
    sizes = {"surfels": [300], "pixels": [32], "gradient": [], "irradiance": (300, 32), "bounce": []}
    outcome = Tracing(**sizes, parts=["error"], error_rays=20).run(tmp_path)
    assert {row.metric.split(".")[0] for row in outcome.rows} == {"primary", "shadow"}
    assert not outcome.pictures


SHADOW_ROWS = [
    *("shadow.mrays_random", "shadow.embree_restart_mrays_random", "shadow.embree_closest_hit_mrays_random"),
    *("shadow.embree_any_hit_mrays_random", "shadow.ratio_to_embree_restart"),
    *("shadow.ratio_to_embree_closest_hit_random", "shadow.ratio_to_embree_any_hit_random"),
    *("shadow.mrays_irradiance", "shadow.embree_closest_hit_mrays_irradiance"),
    *("shadow.embree_any_hit_mrays_irradiance", "shadow.ratio_to_embree_closest_hit"),
    *("shadow.ratio_to_embree_any_hit", "bvh.build_ms", "bvh.embree_build_ms"),
]


def test_shadow_rays_count_the_build():
    seconds = {
        "random tron": 2.0,
        "random embree_restart": 12.0,
        "random embree_closest_hit": 6.0,
        "random embree_any_hit": 1.5,
        "irradiance tron": 3.0,
        "irradiance idle": 1.0,
        "irradiance embree_closest_hit": 7.0,
        "irradiance embree_any_hit": 2.5,
        "build": 1.0,
        "embree_build": 4.0,
    }
    timed = Timed("shadow", "300", {name: Times((value,)) for name, value in seconds.items()})
    rows = list(shadow_rows(timed, rays=4_000_000, pass_rays=6_000_000))
    assert [row.metric for row in rows] == [f"{metric}.300" for metric in SHADOW_ROWS]
    expected = [2, 1 / 3, 2 / 3, 8 / 3, 4, 2, 0.5, 3, 1, 4, 2, 0.5, 1000, 4000]
    assert [row.value for row in rows] == pytest.approx(expected)


def distance(surface: Surface, points: np.ndarray) -> np.ndarray:
    """(N,) unsigned distance of world points (N, 3) to a surface, in closed form."""
    match surface:
        case Floor(half):
            beyond = np.maximum(np.abs(points[:, :2]) - half, 0)
            return np.hypot(np.linalg.norm(beyond, axis=1), points[:, 2])
        case Sphere(centre, radius):
            return np.abs(np.linalg.norm(points - np.array(centre), axis=1) - radius)
        case Torus(centre, major, minor):
            local = points - np.array(centre)
            ring = np.hypot(local[:, 0], local[:, 1]) - major
            return np.abs(np.hypot(ring, local[:, 2]) - minor)
        case Box(centre, half):
            beyond = np.abs(points - np.array(centre)) - half
            outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
            return np.abs(outside + np.minimum(beyond.max(1), 0))
    raise AssertionError(surface)


def test_surfels_lie_on_the_mesh_that_stands_for_them():
    def off(made):
        points = made.means.astype(np.float64)
        return np.min([distance(surface, points) for surface in scene.SURFACES], axis=0)

    assert off(scene.surfels(3000, seed=1, lift=0.0)).max() < 1e-6
    made = scene.surfels(3000, seed=1)
    assert 0 < np.median(off(made) / made.scales().mean(1)) < scene.LIFT
    for surface in scene.SURFACES:
        points, normals, faces = surface.mesh(64)
        assert distance(surface, points).max() < 1e-9
        corners = points[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(surface.area, rel=0.01)
        assert ((cross * normals[faces[:, 0]]).sum(1) > 0).all(), "wound outwards"
        moved = points + 1e-3 * normals
        assert distance(surface, moved) == pytest.approx(np.full(len(points), 1e-3), abs=1e-5)


def test_surfels_are_even_by_area():
    # A low-discrepancy set fills the cells of a grid far more evenly than chance, whose variance is the mean.
    u, v = scene.r2_sequence(6400, np.array([0.3, 0.8]))
    counts = np.histogram2d(u, v, bins=8)[0]
    assert counts.var() < 0.1 * counts.mean()


def test_the_peer_draws_the_same_picture():
    ours, peer, _ = accuracy.compare_images(Contenders(scene.surfels(2000, seed=0)), 48).pictures
    chance = metrics.psnr(ours.image, np.broadcast_to(ours.image.mean((0, 1)), ours.image.shape))
    assert metrics.psnr(ours.image, peer.image) > 20 > chance


def test_the_peer_draws_the_kernel(monkeypatch):
    # One surfel seen from above: across it the picture is the kernel itself, whatever its thickness. A round
    # one, because the peer meets a single flat one far away twice, or not at all: its float32 cancels.
    monkeypatch.setattr(peers, "THINNESS", 1.0)
    made = scene.surfels(300, seed=0)
    one = replace(
        made,
        **{f.name: getattr(made, f.name)[:1] for f in fields(made) if f.name in ARRAYS},
    )
    sigma = 0.2
    for name, value in {
        "means": [[0.0, 0, 0]],
        "quats": [[1.0, 0, 0, 0]],
        "log_scales": np.log([[sigma, sigma]]),
        "opacity_logits": [np.log(0.8 / 0.2)],
        "sh": np.zeros((1, 16, 3)),
    }.items():
        setattr(one, name, np.asarray(value, np.float32))
    view = Camera.look_at((0, 0, 4), (0, 0, 0), up=(0, 1, 0), fov_deg=16, width=33, height=33)
    drawn = peers.through_centres(peers.primitives(one), peers.load_integrator(peers.OUR_STOP), view)
    ours = Contenders(one).tracer.gbuffer(view).numpy()["rgb"]
    radius = 4 * np.abs((np.arange(33) + 0.5 - view.cx) / view.fx) / sigma
    expected = 0.5 * 0.8 * np.exp(-(radius**2) / 2)
    inside = radius < 2.5
    assert inside.sum() > 20
    np.testing.assert_allclose(drawn[16, inside, 0], expected[inside], atol=0.01)
    np.testing.assert_allclose(ours[16, inside, 0], expected[inside], atol=1e-5)


def test_the_peer_with_our_stop_goes_on_where_the_shipped_one_ends():
    contenders = Contenders(scene.surfels(1000, seed=0))
    view = scene.camera(32)
    deep, shipped = (
        peers.through_centres(contenders.primitives, peers.load_integrator(stop), view)
        for stop in (peers.OUR_STOP, peers.SHIPPED_STOP)
    )
    assert (deep >= shipped - 1e-6).all()
    assert 1e-4 < (deep - shipped).max() < 2 * peers.SHIPPED_STOP


def test_restarts_agree_with_the_reference_but_for_coincident_surfels():
    import mitsuba as mi

    made = scene.surfels(800, seed=2)
    rng = seeds.generator(0, "tests", "restart rays")
    origins = rng.uniform(-2, 2, (200, 3)) + np.array([0, 0, 2.0])
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    o, d = (np.ascontiguousarray(a.T, np.float32) for a in (origins, directions))
    found = np.array(
        peers.RestartedShadows(made, peers.quads(made)).transmittance(mi.Point3f(o), mi.Vector3f(d))
    )
    truth, margin = reference.transmittance(made, o.T, d.T)
    wrong = np.abs(found - truth)[margin > 1e-5] > 1e-3
    assert wrong.mean() < 0.03
    assert (truth < 0.5).sum() > 20, "enough rays meet something"


def test_contestants_take_turns_and_slow_ones_sit_out(monkeypatch: pytest.MonkeyPatch):
    calls: list[str] = []
    seconds = {"quick": 0.1, "slow": 2.0}

    def timed(work):
        return seconds[work()]

    def contestant(name):
        def work():
            calls.append(name)
            return name

        return work

    monkeypatch.setattr("eval.timing.seconds_of", timed)
    times = interleaved({name: contestant(name) for name in seconds}, 5)
    assert calls == ["quick", "slow"] * 4 + ["quick"] * 2  # the first round warms up
    assert times["slow"].over(times["quick"]) == pytest.approx(20)
    assert len(times["slow"].seconds) == 3


def test_counts_are_formatted_as_metrics_want_them():
    counts = (10_000, 1_000_000, 2_500_000, 300)
    assert [format_count(count) for count in counts] == ["10k", "1m", "2500k", "300"]

"""The tracing benchmark at toy sizes: its rows, its two scenes, its peers, its yardsticks."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from eval import stages
from eval.cli import cli
from eval.peers import embree, scene, volprim
from eval.peers.contenders import Contenders
from eval.peers.surfaces import Box, Floor, Sphere, Surface, Torus
from eval.peers.timing import Rounds, Times, format_count, interleaved
from eval.results import Results
from eval.tracing import agreement
from eval.tracing.benchmark import Tracing
from eval.tracing.few_rays import RAYS, measure_few_rays
from eval.tracing.irradiance import block_correlation, independent_irradiance, relative_rmse
from eval.tracing.measured import ShadowRays, few_rays_rows
from eval.tracing.memory import measure_memory
from eval.tracing.page_rays import SHADOW_GROUPS
from tron import metrics, seeds
from tron.cameras import Camera
from tron.images import write_image
from tron.shading import EnvironmentLight, irradiance
from tron.tracing import reference

pytestmark = pytest.mark.usefixtures("variant")

TOY = {
    "surfels": "[300,400]",
    "pixels": "[32]",
    "room": "[300,32]",
    "ground": "[400,32]",
    "growth_surfels": "[300,400]",
    "growth_pixels": "[32,64]",
    "shadow_rays": "500",
    "shadow_spp": "2",
    "gradient": "[[300,32]]",
    "irradiance": "[300,32]",
    "noise": "[300,32]",
    "few_rays": "[300,32]",
    "bounce": "[[300,32]]",
    "reference_spp": "64",
    "error_rays": "50",
    "memory_surfels": "500",
    "repetitions": "1",
    "slow_repetitions": "1",
}
ROWS = [
    "primary.ratio_to_volprim.400_32",
    "primary.ratio_to_volprim_as_shipped.400_32",
    "primary.mrays.400_32",
    "primary.ratio_to_embree_closest_hit.400_32",
    "primary.binning_ms.400_32",
    "primary.ratio_to_volprim_sh3.400_32",
    "primary.mrays_from_gbuffers.400_32",
    "primary.ratio_to_volprim.400_64",
    "primary.ratio_to_volprim.room_300_32",
    "primary.ratio_to_volprim_as_shipped.ground_400_32",
    "primary.mrays.room_300_32",
    "primary.binning_ms.ground_400_32",
    "primary.inside_over_outside.300_32",
    "shadow.ratio_to_embree_restart.300",
    "shadow.ratio_to_embree_closest_hit.300",
    "shadow.ratio_to_embree_any_hit.300",
    "shadow.ratio_to_embree_any_hit_random.300",
    "shadow.stray_slowdown.300",
    "bvh.build_ms.300",
    "bvh.refit_ms.300",
    "gradient.ratio_to_volprim.300_32",
    "gradient.cosine_with_volprim.300_32",
    "irradiance.seconds_ratio_to_mitsuba_direct.300_32",
    "irradiance.rmse_2spp",
    "irradiance.rmse_64spp",
    "irradiance.independent_rmse_2spp",
    "irradiance.independent_rmse_64spp",
    "irradiance.independent_rmse_equal_time",
    "irradiance.block_correlation_8x8",
    "irradiance.rmse_64spp.sun",
    "irradiance.rmse_64spp.soft",
    "irradiance.shadowed_mean_over_reference.sun.2",
    "irradiance.shadowed_mean_over_reference.soft.8.filtered",
    "irradiance.few_rays_rmse.sun.4.filtered",
    "irradiance.shadowed_mean_over_reference.least",
    "irradiance.shadowed_mean_over_reference.greatest",
    "primary.max_error",
    "primary.rays_at_a_threshold",
    "shadow.max_error",
    "memory.peak_mb.500",
    "memory.bounce_mb.500",
    "bounce.seconds_ratio_to_frame.300_32",
    "bounce.lit_frame_ratio.300_32",
    "bounce.transport_seconds.300_32",
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
def test_the_whole_benchmark_runs_and_every_promised_row_is_there(tmp_path: Path):
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
        "inside",
        "growth",
        "shadow",
        "gradient",
        "irradiance",
        "noise",
        "few-rays",
        "exactness",
        "memory",
        "bounce",
    ):
        assert f'id="{anchor}"' in page
    assert (tmp_path / "pictures" / "camera.png").stat().st_size > 0


def test_memory_is_measured_beside_a_foreign_eval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "eval.py").write_text("raise SystemExit('a decoy was imported')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # the child's folder is then not first on its path
    assert measure_memory(100, 16, "llvm_ad_rgb", 0)["peak"] > 0


def test_a_part_alone_gives_its_rows_alone(tmp_path: Path):
    settings = {"surfels": [300], "pixels": [32], "growth_surfels": [], "growth_pixels": []}
    benchmark = Tracing(
        **settings,
        parts=["error"],
        room=(300, 32),
        ground=(300, 32),
        gradient=[],
        irradiance=(300, 32),
        noise=(300, 32),
        few_rays=(300, 32),
        bounce=[],
        equal_error=[],
        error_rays=20,
    )
    outcome = benchmark.run(tmp_path)
    assert {row.metric.split(".")[0] for row in outcome.rows} == {"primary", "shadow"}
    assert [section.name for section in outcome.sections] == ["exactness"]


SHADOW_COLUMNS = {
    "random rays, Mrays/s": {
        "TRON": "shadow.mrays_random",
        "restarts": "shadow.embree_restart_mrays_random",
        "closest hit": "shadow.embree_closest_hit_mrays_random",
        "any hit": "shadow.embree_any_hit_mrays_random",
        "× restarts": "shadow.ratio_to_embree_restart",
        "× closest hit": "shadow.ratio_to_embree_closest_hit_random",
        "× any hit": "shadow.ratio_to_embree_any_hit_random",
    },
    "irradiance pass, Mrays/s": {
        "TRON": "shadow.mrays_irradiance",
        "closest hit": "shadow.embree_closest_hit_mrays_irradiance",
        "any hit": "shadow.embree_any_hit_mrays_irradiance",
        "× closest hit": "shadow.ratio_to_embree_closest_hit",
        "× any hit": "shadow.ratio_to_embree_any_hit",
    },
    "hierarchy, ms": {
        "build": "bvh.build_ms",
        "refit": "bvh.refit_ms",
        "Embree's build": "bvh.embree_build_ms",
    },
    "tracing, × time": {"after refit": "bvh.trace_after_refit", "with strays": "shadow.stray_slowdown"},
}


def test_equal_errors_are_the_data_engines_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The data engine is asked to make scenes once, and to judge them every time; its ratios become rows."""
    asked = []

    def work(children):
        (child,) = children
        asked.append(child.arguments)
        dataset = tmp_path / "models"
        (dataset / "equal_error").mkdir(parents=True, exist_ok=True)
        write_image(dataset / "equal_error" / "a-l0.png", np.full((4, 12, 3), 0.5, np.float32))
        ways = {
            name: {
                "error": 0.02,
                "seconds": 1.0,
                "paths": 8.0,
                "path_seconds": 2.5,
                "ratio": ratio,
                "ratio_with_bake": ratio + 0.1,
            }
            for name, ratio in (("lit_preview", 0.4), ("lit_16_rays", 1.2))
        }
        cases = [{"scene": name, "light": "dusk", "ways": ways} for name in ("a", "b")]
        (dataset / "equal_error.json").write_text(json.dumps({"cases": cases}))

    monkeypatch.setattr(stages, "run_together", work)
    command = [
        "benchmark=tracing", "benchmark.parts=[equal_error]", f"output_dir={tmp_path}",
        'benchmark.equal_error=["experiment=models","assets=x"]',
    ]  # fmt: skip
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            cli(command)
        assert end.value.code == 0
    folder = f"output_dir={tmp_path / 'models'}"
    making = ["experiment=models", "assets=x", folder]
    judging = [*making, "mode=equal_error"]
    assert [list(each) for each in asked] == [making, judging, judging]
    results = Results.load(tmp_path / "results.json")
    row = results.find("guidance.ratio_to_path_tracing.equal_error")
    assert row is not None
    assert (row.value, row.scenes, row.ratio) == (0.4, 2, 0.8)
    assert results.value("guidance.ratio_to_path_tracing.equal_error.lit_16_rays") == 1.2
    assert results.value("guidance.ratio_to_path_tracing.equal_error.with_bake") == 0.5
    page = (tmp_path / "report.html").read_text()
    assert 'id="equal-error"' in page
    assert "a, dusk" in page


def test_shadow_rays_stand_under_their_headings_and_count_the_build():
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
        "refit": 0.5,
        "embree_build": 4.0,
        "rebuilt": 2.0,
        "refitted": 2.5,
        "strays": 3.0,
    }
    times = {name: Times((value,)) for name, value in seconds.items()}
    rows = list(ShadowRays(300, 32, times, rays=4_000_000, pass_rays=6_000_000).rows())
    assert {title: tuple(group) for title, group in SHADOW_COLUMNS.items()} == SHADOW_GROUPS
    columns = [metric for group in SHADOW_COLUMNS.values() for metric in group.values()]
    assert [row.metric for row in rows] == [f"{metric}.300" for metric in columns]
    expected = [2, 1 / 3, 2 / 3, 8 / 3, 4, 2, 0.5, 3, 1, 4, 2, 0.5, 1000, 500, 4000, 1.25, 1.5]
    assert [row.value for row in rows] == pytest.approx(expected)


def test_few_rays_are_held_to_many_in_every_way():
    found = measure_few_rays(Contenders(scene.surfels(500, seed=1)), 16, "soft", 64, seed=0)
    rows = {row.metric.removeprefix("irradiance."): row.value for row in few_rays_rows([found])}
    assert len(rows) == 2 * 2 * len(RAYS) + 2
    means = [value for name, value in rows.items() if name.startswith("shadowed_mean_over_reference.soft")]
    assert rows["shadowed_mean_over_reference.least"] == min(means) > 0
    assert rows["shadowed_mean_over_reference.greatest"] == max(means)
    assert rows["few_rays_rmse.soft.8"] < rows["few_rays_rmse.soft.2"], "more rays, less noise"


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

    assert off(scene.surfels(3000, seed=1, recipe=replace(scene.STUDY, lift=0.0))).max() < 1e-6
    made = scene.surfels(3000, seed=1)
    assert 0 < np.median(off(made) / made.scales().mean(1)) < scene.STUDY.lift
    for surface in scene.SURFACES:
        points, normals, faces = surface.mesh(64)
        assert distance(surface, points).max() < 1e-9
        corners = points[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(surface.area, rel=0.01)
        assert ((cross * normals[faces[:, 0]]).sum(1) > 0).all(), "wound outwards"
        moved = points + 1e-3 * normals
        assert distance(surface, moved) == pytest.approx(np.full(len(points), 1e-3), abs=1e-5)


@pytest.mark.parametrize("place", [scene.ROOM, scene.GROUND])
def test_cameras_inside_stand_among_surfels_on_all_sides_that_face_them(place):
    made, view = scene.surfels(3000, 0, place=place), place.camera(32)
    means = made.means.astype(np.float64)
    off = np.min([distance(surface, means) for surface in place.surfaces], axis=0)
    assert np.median(off / made.scales().mean(1)) < scene.STUDY.lift
    to_centre = made.means - view.position
    around = made.object_id == 0
    assert ((made.normals() * to_centre).sum(1) < 0)[around].mean() > 0.9
    depth = to_centre @ view.world_to_camera[2, :3]
    assert 0.05 < (depth[around] < 0).mean() < 0.8
    assert (np.abs(depth) < made.scales().max(1)).sum() > 20, "some cross the plane through the camera"


def test_surfels_are_even_by_area():
    # A low-discrepancy set fills the cells of a grid far more evenly than chance, whose variance is the mean.
    u, v = scene.r2_sequence(6400, np.array([0.3, 0.8]))
    counts = np.histogram2d(u, v, bins=8)[0]
    assert counts.var() < 0.1 * counts.mean()


def test_a_ray_of_the_study_scene_hits_what_the_study_hit():
    hit, front, effective = agreement.hits_a_ray(scene.surfels(10_000, seed=0), 64, seed=0)
    assert hit == pytest.approx(33, rel=0.2)
    assert front == pytest.approx(23, rel=0.2)
    assert effective == pytest.approx(18, rel=0.2)


def test_the_peer_draws_the_same_picture():
    contenders = Contenders(scene.surfels(2000, seed=0))
    found = agreement.compare_images(contenders, 48)
    chance = metrics.psnr(found.tron, np.broadcast_to(found.tron.mean((0, 1)), found.tron.shape))
    assert found.psnr > 20 > chance


@pytest.mark.parametrize("degree", [2, 4])
def test_the_peer_draws_the_kernel_that_it_is_given(degree, monkeypatch):
    # One surfel seen from above: across it the picture is the kernel itself, whatever its thickness. A round
    # one, because the peer meets a single flat one far away twice, or not at all: its float32 cancels.
    monkeypatch.setattr(volprim, "THINNESS", 1.0)
    made = scene.surfels(300, seed=0)
    one = replace(
        made,
        **{f.name: getattr(made, f.name)[:1] for f in fields(made) if f.name in ARRAYS},
        kernel_degree=degree,
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
    drawn = volprim.through_centres(
        volprim.primitives(one, 0), volprim.load_integrator(volprim.OUR_STOP, degree), view
    )
    ours = Contenders(one).tracer.gbuffer(view).numpy()["rgb"]
    radius = 4 * np.abs((np.arange(33) + 0.5 - view.cx) / view.fx) / sigma
    expected = 0.5 * 0.8 * (np.exp(-(radius**2) / 2) if degree == 2 else np.exp(-(radius**4) / 18))
    inside = radius < 2.5
    assert inside.sum() > 20
    np.testing.assert_allclose(drawn[16, inside, 0], expected[inside], atol=0.01)
    np.testing.assert_allclose(ours[16, inside, 0], expected[inside], atol=1e-5)


def test_the_peer_with_our_stop_goes_on_where_the_shipped_one_ends():
    contenders = Contenders(scene.surfels(1000, seed=0))
    view = scene.camera(32)
    deep, shipped = (
        volprim.through_centres(contenders.primitives, volprim.load_integrator(stop), view)
        for stop in (volprim.OUR_STOP, volprim.SHIPPED_STOP)
    )
    assert (deep >= shipped - 1e-6).all()
    assert 1e-4 < (deep - shipped).max() < 2 * volprim.SHIPPED_STOP


def test_restarts_agree_with_the_reference_but_for_coincident_surfels():
    import mitsuba as mi

    made = scene.surfels(800, seed=2)
    rng = seeds.generator(0, "tests", "restart rays")
    origins = rng.uniform(-2, 2, (200, 3)) + np.array([0, 0, 2.0])
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    o, d = (np.ascontiguousarray(a.T, np.float32) for a in (origins, directions))
    found = np.array(
        embree.RestartedShadows(made, embree.quads(made)).transmittance(mi.Point3f(o), mi.Vector3f(d))
    )
    truth, margin = reference.transmittance(made, o.T, d.T)
    wrong = np.abs(found - truth)[margin > 1e-5] > 1e-3
    assert wrong.mean() < 0.03
    assert (truth < 0.5).sum() > 20, "enough rays meet something"


def test_independent_sampling_has_the_same_mean_as_the_pass():
    contenders = Contenders(scene.surfels(1000, seed=0))
    from eval.tracing.lights import soft

    light, gbuffer = EnvironmentLight(soft()), contenders.tracer.gbuffer(scene.camera(32))
    ours = np.array(irradiance(contenders.tracer, gbuffer, light, 256, seed=0)[0])
    plain = np.array(independent_irradiance(contenders.tracer, gbuffer, light, 256, seed=0)[0])
    assert ours.mean() == pytest.approx(plain.mean(), rel=0.01)
    assert np.abs(ours - plain).max() > 1e-3, "different rays"


def test_block_correlation_tells_blocks_from_noise_and_from_blue_noise():
    rng = seeds.generator(0, "tests", "blocks")
    noise = rng.normal(size=(8, 96, 96))
    surface = np.ones((96, 96), bool)
    shared = np.kron(rng.normal(size=(8, 24, 24)), np.ones((4, 4)))
    blue = noise - (np.roll(noise, 1, 1) + np.roll(noise, 1, 2)) / 2
    assert abs(block_correlation(noise, surface, 4)) < 0.02
    assert abs(block_correlation(blue, surface, 4)) < 0.02
    assert block_correlation(shared, surface, 4) == pytest.approx(1, abs=0.1)
    assert 0.2 < block_correlation(noise + 0.7 * shared, surface, 4) < 0.5


def test_relative_rmse_is_the_deviation_over_the_planes_light():
    truth = np.ones((16, 16, 3))
    surface = np.zeros((16, 16), bool)
    surface[:8] = True
    off = truth + np.where(surface, 0.3, 100.0)[..., None]
    assert relative_rmse([off, truth - (off - truth)], truth, surface, plane=2.0) == pytest.approx(0.15)


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

    monkeypatch.setattr("eval.peers.timing.seconds_of", timed)
    times = interleaved({name: contestant(name) for name in seconds}, Rounds(4, 2))
    assert calls == ["quick", "slow"] * 3 + ["quick"] * 2  # the first round warms up
    assert times["slow"].over(times["quick"]) == pytest.approx(20)
    assert Times((1.0, 2.0, 6.0)).range_over(Times((1.0, 1.0))) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("count", "text"), [(10_000, "10k"), (1_000_000, "1m"), (2_500_000, "2500k"), (300, "300")]
)
def test_counts_are_formatted_as_metrics_want_them(count: int, text: str):
    assert format_count(count) == text

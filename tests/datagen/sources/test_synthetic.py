"""The figures that surfels and guidance must reach on views and lights they were not made from."""

import numpy as np
import pytest

from datagen.dataset.records import Work
from datagen.dataset.spool import first_bad_value
from datagen.files.sources import Sources
from datagen.settings.command import Settings
from datagen.sources.synthetic import make_clips, make_surfels
from datagen.truth import build as building
from datagen.truth.build import draw_and_build
from datagen.truth.pathtrace import direct_irradiance, gbuffers, render_frames
from datagen.world.lights import Family
from tron import metrics
from tron.cli.recipes import check, compose_recipe
from tron.color import luminance, to_display
from tron.estimation import Estimation
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.seeds import integer
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.guidance import Lighting, render_guidance
from tron.tracing import SurfelTracer

SIZE = 96
LEAST_DB: dict[Family, float] = {"sun": 26.0, "studio": 26.0, "overcast": 28.0}


def test_values_that_are_not_finite_are_found_where_they_are():
    frames = [{"pbr": np.zeros((2, 3, 3)), "irradiance": np.ones((2, 3, 3))} for _ in range(3)]
    assert first_bad_value(frames) is None
    frames[2]["irradiance"][1, 1] = (np.inf, 0, np.nan)
    assert first_bad_value(frames) == "frame 2: irradiance has 2 values that are not finite"


def test_scenes_take_the_styles_of_a_list_in_turns_and_the_kinds_of_their_split(tmp_path, monkeypatch):
    styles, kinds = [], set()

    def drawn(*_, style, choice, **__) -> None:
        styles.append(style)
        kinds.add((choice.things, choice.materials))

    monkeypatch.setattr(building, "draw_scene", drawn)
    monkeypatch.setattr(building, "scene_geometry", lambda *_: None)
    words = ["train.style=[object,table]", "train.things=[vase,mug]", "train.materials=[metal]"]
    words += ["test.things=[book]", f"output_dir={tmp_path}"]
    settings = check(compose_recipe("conf.datagen", Settings, words), Settings)
    for k in range(3):
        draw_and_build(Work("train", k, f"train-{k:06d}", first_shard=0), settings, Sources(), ["overcast"])
    assert styles == ["object", "table", "object"]
    assert kinds == {(("vase", "mug"), ("metal",))}


@pytest.fixture(scope="module")
def shared(variant, tmp_path_factory):
    """A scene whose lights share a path, its surfels, its settings and its clips."""
    tiny = [f"test.{key}" for key in ("frames=2", "width=24", "height=16", "path_spp=64", "reference_spp=4")]
    tiny += ["test.lights=[studio,overcast,sun]", "test.lights_share_path=true", "test.guidance_spp=4"]
    tiny += ["cluster=null", "path_frames=8", "views=8", "view_width=48", "view_height=48", "surfels=3000"]
    tiny += ["refine_steps=0", "mesh_edge=0.2", "environment_height=16", "objects=[2,2]", "seed=11"]
    tiny += [f"output_dir={tmp_path_factory.mktemp('shared')}"]
    settings = check(compose_recipe("conf.datagen", Settings, tiny), Settings)
    item = Work("test", 0, "test-000000", first_shard=0)
    spec, geometry = draw_and_build(item, settings, Sources(), settings.test.lights)
    surfels, _ = make_surfels(spec, geometry, settings)
    clips = [(meta, list(frames)) for meta, frames in make_clips(spec, geometry, surfels, settings)]
    return spec, geometry, surfels, settings, clips


def test_lights_that_share_a_path_have_clips_of_their_own_from_the_same_cameras(shared):
    spec, _, _, _, clips = shared
    assert [meta.light_family for meta, _ in clips] == ["studio", "overcast", "sun"]
    assert [meta.key for meta, _ in clips] == [f"{spec.name}-l{k}" for k in range(3)]
    assert all(meta.cameras == clips[0][0].cameras for meta, _ in clips)
    assert len({meta.seeds["guidance0"] for meta, _ in clips}) == 3
    assert len({meta.seeds["path0"] for meta, _ in clips}) == 1
    for i in range(2):
        for name in ("mask", "foreground", "base_color", "depth_ref"):
            images = [frames[i][name] for _, frames in clips]
            np.testing.assert_array_equal(images[0], images[1])
            np.testing.assert_array_equal(images[0], images[2])
        assert not np.allclose(clips[0][1][i]["rgb"], clips[1][1][i]["rgb"])


def test_guidance_of_shared_frames_is_that_of_each_light_alone(shared):
    spec, _, surfels, settings, clips = shared
    tracer, estimation = SurfelTracer(surfels), settings.estimation("test")
    seed = integer(spec.seed, "test", 0, "bounce")
    transport = BounceTransport.trace(tracer.sided(estimation.two_sided), seed=seed)
    for number, (meta, frames) in enumerate(clips):
        environment = spec.lights[number].bake(16)
        lighting = Lighting(environment)
        seed = integer(spec.seed, "test", 0, "light", number, "bounce")
        bounce = transport.bake(lighting, estimation, seed=seed)
        for i, camera in enumerate(spec.clip(number, 2, 24, 16)):
            seed = integer(spec.seed, "test", 0, "light", number, "frame", i, "guidance")
            alone = render_guidance(tracer, camera, lighting, estimation, seed, bounce=bounce)
            for name in ("pbr", "irradiance", "lit"):
                np.testing.assert_allclose(frames[i][name], alone[name], rtol=2e-3, atol=1e-5)
        assert meta.exposure == pytest.approx(environment.exposure())


def test_shared_frames_are_path_traced_as_each_light_alone(shared):
    spec, geometry, _, _, clips = shared
    for number, (meta, frames) in enumerate(clips):
        environment = spec.lights[number].bake(16)
        cameras = spec.clip(number, 2, 24, 16)
        truth = render_frames(geometry.lit(environment), cameras, 1024, [3, 4])
        for i, image in enumerate(truth):
            off = np.asarray(to_display(frames[i]["rgb"], meta.exposure)) - to_display(image, meta.exposure)
            assert np.sqrt((off**2).mean()) < 0.03
            assert abs(frames[i]["rgb"].mean() / image.mean() - 1) < 0.02


@pytest.mark.long
@pytest.mark.parametrize("index", [0, 1, 2])
def test_20k_surfels_and_their_irradiance_on_held_out_views_of_textured_scenes(index, variant):
    families = tuple(LEAST_DB)
    demo = check(compose_recipe("conf.datagen", Settings, ["experiment=demo", "output_dir=data"]), Settings)
    item = Work("test", index, f"test-{index:06d}", first_shard=0)
    spec, geometry = draw_and_build(item, demo, Sources(), families)
    surfels = surfels_from_gbuffers(gbuffers(geometry, spec.views(32, 128, 128)), count=20_000)
    assert len(surfels) == pytest.approx(20_000, rel=0.02)
    tracer = SurfelTracer(surfels)
    leaking = shadowed = darkened = lit = 0
    for number, (family, light) in enumerate(zip(families, spec.lights)):
        environment = light.bake(128)
        camera = spec.clip(number, 5, SIZE, SIZE)[2]
        truth = gbuffers(geometry, [camera])[0]
        ours = render_guidance(tracer, camera, Lighting(environment), Estimation(rays=64), seed=number)
        direct = direct_irradiance(geometry, geometry.lit(environment), camera, 256, seed=number)

        seen = truth.valid
        assert metrics.psnr(ours.gbuffer["base_color"], truth.base_color, seen) >= 28
        assert metrics.angular_error_deg(ours.gbuffer["normal"], truth.normal, seen) <= 5
        shown = [
            np.asarray(to_display(image, environment.exposure()))
            for image in (ours.irradiance, direct.shadowed)
        ]
        assert metrics.psnr(shown[0], shown[1], seen) >= LEAST_DB[family], family

        # Errors of shadows are counted where both see the same surface.
        depth = np.linalg.norm(truth.position - camera.position, axis=-1)
        same = seen & (np.abs(depth - ours.gbuffer["depth"].reshape(depth.shape)) < 0.03)
        reference, open_sky, estimate = (
            np.asarray(luminance(image)) for image in (direct.shadowed, direct.unshadowed, ours.irradiance)
        )
        share = reference / np.maximum(open_sky, 1e-6)
        dark, bright = same & (share < 0.5), same & (share > 0.9)
        shadowed, lit = shadowed + dark.sum(), lit + bright.sum()
        leaking += (estimate > reference + 0.15 * reference[seen].mean())[dark].sum()
        darkened += (estimate < 0.75 * reference)[bright].sum()
    assert shadowed > 200
    assert leaking <= 0.02 * shadowed
    assert darkened <= 0.03 * lit

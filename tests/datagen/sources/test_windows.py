"""Windows of larger pictures show what the pictures show, and say how they were sampled."""

from collections import Counter

import numpy as np
import pytest

from datagen.dataset.records import Work
from datagen.files.sources import Sources
from datagen.settings.command import Settings
from datagen.sources.synthetic import make_clips, make_surfels
from datagen.sources.windows import MARGIN, Window, draw_windows
from datagen.truth.build import FIRST_ID, draw_and_build
from datagen.truth.pathtrace import gbuffers
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.estimation import FINEST
from tron.relighting import Relighter
from tron.shards.schema import clip_members

TINY = [
    *("test.frames=2", "test.width=24", "test.height=16", "test.path_spp=4", "test.reference_spp=4"),
    *("test.lights=[studio,overcast,sun]", "test.window_of=[96]", "test.guidance_spp=[preview,8,final]"),
    *("cluster=null", "path_frames=8", "views=8", "view_width=48", "view_height=48", "surfels=3000"),
    *("refine_steps=0", "mesh_edge=0.2", "environment_height=16", "objects=[2,2]", "seed=11"),
]


@pytest.fixture(scope="module")
def windowed(variant, tmp_path_factory):
    """A scene, its surfels, its settings, and its clips of windows of pictures 96 pixels wide."""
    words = [*TINY, f"output_dir={tmp_path_factory.mktemp('windowed')}"]
    settings = check(compose_recipe("conf.datagen", Settings, words), Settings)
    item = Work("test", 0, "test-000000", first_shard=0)
    spec, geometry = draw_and_build(item, settings, Sources(), settings.test.lights)
    surfels, _ = make_surfels(spec, geometry, settings)
    clips = [(meta, list(frames)) for meta, frames in make_clips(spec, geometry, surfels, settings)]
    return spec, geometry, surfels, settings, clips


def test_a_window_has_the_rays_of_its_pixels():
    whole = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=40, width=60, height=40)
    part = whole.window(11, 7, 20, 15)
    np.testing.assert_allclose(part.exact_rays(), whole.exact_rays()[7:22, 11:31], atol=1e-12)


def test_a_margin_ends_with_the_picture_and_is_cut_off_again():
    picture = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=40, width=90, height=78)
    window = Window(picture, x=4, y=58, width=24, height=16)
    wide = window.with_margin()
    assert (wide.x, wide.y) == (0, 58 - MARGIN)
    assert (wide.width, wide.height) == (4 + 24 + MARGIN, MARGIN + 16 + min(MARGIN, 78 - 58 - 16))
    cut = window.cut({"rays": wide.camera.exact_rays()})
    np.testing.assert_allclose(cut["rays"], window.camera.exact_rays(), atol=1e-12)


def test_frames_of_windows_are_parts_of_whole_pictures(windowed):
    spec, geometry, surfels, settings, clips = windowed
    number = [meta.spp["guidance"] for meta, _ in clips].index(8)  # one sample a pixel
    meta, frames = clips[number]
    relighter = Relighter(surfels, settings.estimation("test", 0, number), proxy="never")
    light = relighter.under(spec.lights[number].bake(16).baked())
    for window, camera, frame in zip(
        draw_windows(spec, geometry, settings.test, 0), meta.cameras, frames, strict=True
    ):
        assert Camera.from_dict(camera).to_dict() == window.camera.to_dict()
        rows, columns = slice(window.y, window.y + 16), slice(window.x, window.x + 24)
        (truth,) = gbuffers(geometry, [window.picture])
        np.testing.assert_array_equal(frame["foreground"], truth.valid[rows, columns])
        whole = light.render(window.picture)
        np.testing.assert_allclose(frame["pbr"], whole.pbr[rows, columns], rtol=2e-3, atol=1e-4)
        (maps,) = relighter.surface_maps(window.picture, relighter.estimation)
        np.testing.assert_allclose(frame["albedo"], maps["albedo"][rows, columns], atol=2e-3)
        assert frame["foreground"].mean() > 0
        gbuffer = relighter.gbuffer(window.picture).numpy()
        np.testing.assert_allclose(frame["base_color"], gbuffer["base_color"][rows, columns], atol=2e-3)
        for name in clip_members(reference=True):
            assert frame[name].shape[:2] == (16, 24), name


def test_neighbours_share_a_place_and_single_frames_do_not(windowed):
    spec, geometry, _, settings, _ = windowed
    clip = draw_windows(spec, geometry, settings.test, 0)
    assert {w.picture.width for w in clip} == {96}
    assert max(np.ptp([(w.x, w.y) for w in clip], axis=0)) < 24
    recipe = settings.test.model_copy(update={"window_each": "frame", "window_of": [24, 48, 96]})
    single = [window for light in range(8) for window in draw_windows(spec, geometry, recipe, light)]
    assert {w.picture.width for w in single} == {24, 48, 96}
    assert all((w.x, w.y) == (0, 0) for w in single if w.picture.width == 24)
    assert len({(w.x, w.y) for w in single if w.picture.width == 96}) > 1
    again = draw_windows(spec, geometry, recipe, 0)  # the same from the same seed
    assert [(w.x, w.y, w.picture.width) for w in single[:2]] == [(w.x, w.y, w.picture.width) for w in again]


def test_every_other_window_is_about_an_object(windowed):
    spec, geometry, _, settings, _ = windowed
    recipe = settings.test.model_copy(update={"window_each": "frame"})
    about = Counter()
    for light in range(16):
        for window in draw_windows(spec, geometry, recipe, light):
            (seen,) = gbuffers(geometry, [window.camera])
            assert seen.valid.any()
            about[bool((seen.object_id[seen.valid] >= FIRST_ID + len(spec.surroundings)).any())] += 1
    assert about[True] >= 0.4 * about.total()


def test_neighbours_follow_a_point(windowed):
    """Of a walk as long as the picture: the window moves with what it was about."""
    spec, geometry, _, settings, _ = windowed
    recipe = settings.test.model_copy(update={"frames": 8, "window_of": [384]})
    start = spec.cameras.model_copy(update={"first_frame": 0})
    moving = spec.model_copy(update={"cameras": start})
    windows = draw_windows(moving, geometry, recipe, 0)
    (seen,) = gbuffers(geometry, [windows[0].camera])
    point = seen.position[8, 12]
    for window in windows:
        (place,), _ = window.camera.project(point[None])
        inside = 0 < window.x < 384 - 24 and 0 < window.y < 256 - 16
        assert not inside or np.abs(place - (12, 8)).max() < 4
    assert len({(w.x, w.y) for w in windows}) > 1


def test_clips_take_qualities_in_turn_and_say_so(windowed):
    *_, clips = windowed
    found = {meta.spp["guidance"]: meta for meta, _ in clips}
    assert {rays: meta.extra["filtered"] for rays, meta in found.items()} == {0: True, 8: False, 64: True}
    assert {rays: meta.extra["sub_pixels"] for rays, meta in found.items()} == {0: 1, 8: 1, 64: 2}
    assert found[64].spp["reflections"] == FINEST.reflections
    told = {0: (1 / 3, 0.5), 8: (0, 0.3), 64: (1, 0.6)}
    for meta, frames in clips:
        kind_and_rays = frames[0]["sampling"][..., :2].reshape(-1, 2)
        np.testing.assert_allclose(
            kind_and_rays, [told[meta.spp["guidance"]]] * len(kind_and_rays), atol=2e-3
        )


def test_no_quality_goes_with_a_light_or_a_scene(windowed):
    """Of 64 scenes each light of a list has each quality about as often."""
    _, _, _, settings, _ = windowed
    counts = Counter(
        (light, settings.estimation("test", k, light).rays) for k in range(64) for light in (0, 1, 2)
    )
    assert len(counts) == 9
    assert min(counts.values()) > 8


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["bounces=0"], "guidance_spp=final shows light that bounces"),
        (["supersample=2"], "guidance_spp=final has reflections and sub-pixels of its own"),
        (["test.guidance_spp=fast"], "preview"),
        (["surfels=some"], "auto"),
    ],
)
def test_what_does_not_go_together_is_said_before_anything_is_made(tmp_path, words, said):
    with pytest.raises(TronError, match=said):
        check(compose_recipe("conf.datagen", Settings, [*TINY, *words, f"output_dir={tmp_path}"]), Settings)


def test_a_picture_smaller_than_its_window_is_refused(tmp_path):
    with pytest.raises(TronError, match=r"a picture of 16 pixels has no window of width=24"):
        check(
            compose_recipe(
                "conf.datagen", Settings, [*TINY, "test.window_of=[16]", f"output_dir={tmp_path}"]
            ),
            Settings,
        )

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
from tron.estimation import FINEST, PREVIEW
from tron.relighting import Relighter

TINY = [
    *(
        f"test.{key}"
        for key in ("frames=2", "width=24", "height=16", "path_spp=4", "reference_buffers=false")
    ),
    *("test.lights=[studio,overcast,sun]", "test.window_of=[96]", "test.guidance_spp=[preview,8,final]"),
    *(
        "cluster=null",
        "path_frames=8",
        "views=8",
        "view_width=48",
        "view_height=48",
        "surfels=3000",
        "seed=11",
    ),
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
    picture = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=40, width=60, height=40)
    window = Window(picture, x=4, y=20, width=24, height=16)
    wide = window.with_margin()
    assert (wide.x, wide.y) == (0, 20 - MARGIN)
    assert (wide.width, wide.height) == (4 + 24 + MARGIN, MARGIN + 16 + 4)
    cut = window.cut({"rays": wide.camera.exact_rays()})
    np.testing.assert_allclose(cut["rays"], window.camera.exact_rays(), atol=1e-12)


def test_frames_of_windows_are_parts_of_whole_pictures(windowed):
    spec, geometry, surfels, settings, clips = windowed
    meta, frames = clips[1]  # eight rays, unfiltered
    relighter = Relighter(surfels, settings.estimation("test", 0, 1), proxy="never")
    light = relighter.under(spec.lights[1].bake(16).baked())
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


def test_neighbours_share_a_place_and_single_frames_do_not(windowed):
    spec, geometry, _, settings, _ = windowed
    clip = draw_windows(spec, geometry, settings.test, 0)
    assert len({(w.x, w.y, w.picture.width) for w in clip}) == 1
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


def test_clips_take_qualities_in_turn_and_say_so(windowed):
    _, _, _, settings, clips = windowed
    assert [meta.spp["guidance"] for meta, _ in clips] == [2, 8, 64]
    assert [meta.extra["filtered"] for meta, _ in clips] == [True, False, True]
    assert [meta.extra["sub_pixels"] for meta, _ in clips] == [1, 1, 2]
    assert clips[2][0].spp["reflections"] == FINEST.reflections
    assert settings.estimation("test", scene=1, light=2).rays == PREVIEW.rays  # scenes begin elsewhere
    for (_, frames), kind, rays in zip(clips, (1 / 3, 0, 1), (0.1, 0.3, 0.6), strict=True):
        assert frames[0]["sampling"][..., 0].max() == pytest.approx(kind, rel=0.02)
        assert frames[0]["sampling"][..., 1].max() == pytest.approx(rays, rel=0.02)


def test_a_picture_smaller_than_its_window_is_refused(tmp_path):
    with pytest.raises(TronError, match=r"a picture of 16 pixels has no window of width=24"):
        check(
            compose_recipe(
                "conf.datagen", Settings, [*TINY, "test.window_of=[16]", f"output_dir={tmp_path}"]
            ),
            Settings,
        )

"""What moves within a clip moves in the truth and in its guidance alike, and is back afterwards."""

import mitsuba as mi
import numpy as np
import pytest

from datagen.settings.command import Settings
from datagen.sources.synthetic import make_clips, make_surfels
from datagen.truth.build import FIRST_ID, build
from datagen.truth.pathtrace import gbuffers, render_frames
from datagen.world.lights import Light
from datagen.world.motion import STILL, Share, draw_motion
from datagen.world.scene import draw_scene
from datagen.world.styles import Choice
from tron import metrics
from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.flow import both_see, flow, warp
from tron.seeds import generator
from tron.shards.moving import Moving

SIZE = 48


def settings(folder, **split):
    recipe = {
        "scenes": 1,
        "frames": 3,
        "width": SIZE,
        "height": SIZE,
        "path_spp": 36,
        "guidance_spp": 16,
        "lights": ["studio", "overcast"],
    }
    return Settings.model_validate(
        {
            "output_dir": folder,
            "train": recipe | split,
            "views": 24,
            "view_width": 64,
            "view_height": 64,
            "surfels": 6000,
            "refine_steps": 0,
            "environment_height": 32,
            "path_frames": 8,
            "bounces": 1,
        }
    )


def drawn(share, shared, lights=("studio", "overcast")):
    return draw_scene(
        5,
        "train",
        1,
        style="object",
        lights=lights,
        choice=Choice(objects=(3, 3)),
        frames=3,
        path_frames=8,
        lights_share_path=shared,
        moving=share,
    )


@pytest.fixture(scope="module", params=[True, False], ids=["shared", "apart"])
def filmed(request, variant, tmp_path_factory):
    """Specification, true vertices before and after, and the clips of a scene whose topmost object moves."""
    spec, wanted = (
        drawn(Share(objects=1.0, lights=1.0), request.param),
        settings(tmp_path_factory.mktemp("m")),
    )
    geometry = build(spec, edge=0.2)
    shape = geometry.surfaces[0].shape
    before = np.array(mi.traverse(shape)["vertex_positions"])
    surfels, _ = make_surfels(spec, geometry, wanted)
    clips = [(meta, list(frames)) for meta, frames in make_clips(spec, geometry, surfels, wanted)]
    return spec, before, np.array(mi.traverse(shape)["vertex_positions"]), clips


def test_nothing_is_drawn_to_move_where_nothing_may():
    spec = drawn(STILL, True)
    assert spec.motion is None
    assert spec.turns_deg == ()
    motion, turns = draw_motion(generator(0, "m"), spec.objects, 3, Share(1.0, 1.0))
    assert motion is not None
    heights = [item.placement.position[2] for item in spec.objects]
    assert heights[motion.object] == max(heights), "nothing lies on what moves"
    assert len(turns) == 3
    assert all(15 <= abs(turn) <= 90 for turn in turns)


def test_an_object_begins_where_it_rests_rises_and_then_turns():
    spec = drawn(Share(objects=1.0), True)
    item = spec.objects[spec.motion.object]
    start, middle, end = (spec.motion.pose(item, time) for time in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(start.rotation, np.eye(3))
    np.testing.assert_allclose(start.shift, 0.0)
    assert 0 < middle.shift[2] < end.shift[2] == pytest.approx(spec.motion.lift)
    assert np.arccos(0.5 * (np.trace(end.rotation) - 1)) == pytest.approx(
        np.radians(abs(spec.motion.turn_deg))
    )


def test_the_scene_is_as_it_was_after_its_clips(filmed):
    _, before, after, _ = filmed
    np.testing.assert_array_equal(before, after)


def test_the_truth_shows_the_object_rise_and_guidance_follows_it(filmed):
    spec, _, _, clips = filmed
    for meta, frames in clips:
        shown = [
            [np.asarray(to_display(frame[name], meta.exposure)) for name in ("rgb", "lit")]
            for frame in frames
        ]
        errors = [metrics.psnr(lit, rgb) for rgb, lit in shown]
        assert min(errors[1:]) > errors[0] - 4.0, "guidance that stays behind is far from the truth"
        assert min(errors) > 20
        assert meta.extra["moving_object"]
        assert meta.extra["turn_deg"] in spec.turns_deg


def test_flow_by_the_motion_in_the_metadata_is_where_the_truth_shows_the_object_again(filmed):
    """Two frames of true geometry: points that both see are one place of the object in its own frame."""
    spec, _, _, clips = filmed
    geometry, number = build(spec, edge=0.2), FIRST_ID + len(spec.surroundings) + spec.motion.object
    for meta, _ in clips:
        moving = Moving.of(meta)
        assert moving is not None
        assert moving.text() == meta.extra["motion"]
        cameras = [Camera.from_dict(each) for each in meta.cameras]
        seen = []
        for i, camera in enumerate(cameras):
            geometry.move(number, spec.motion.pose(spec.objects[spec.motion.object], i / 2))
            (view,) = gbuffers(geometry, [camera])
            np.testing.assert_array_equal(moving.pixels[i], view.valid & (view.object_id == number))
            seen.append(np.where(view.valid, np.linalg.norm(view.position - camera.position, axis=-1), 0))
        for i, j in ((1, 0), (2, 1)):
            pixels, motion = moving.between(i, j)
            np.testing.assert_array_equal(pixels, moving.pixels[i])
            args = (seen[i], cameras[i], seen[j], cameras[j], pixels)
            both = both_see(*args, motion)
            assert both[moving.pixels[i]].mean() > 0.1
            assert both[moving.pixels[i]].mean() > both_see(*args, np.eye(4))[moving.pixels[i]].mean()
            displacement = flow(seen[i], cameras[i], cameras[j], pixels, motion)
            landed = warp(moving.pixels[j][..., None].astype(float), displacement)[..., 0]
            # where it touches what it rests on, depth tells no edge
            assert (landed[both & moving.pixels[i]] > 0.99).mean() > 0.9


def test_a_still_camera_stays_where_the_path_had_it():
    walking, standing = (
        draw_scene(5, "train", 1, style="table", lights=["sun"], frames=3, still_camera=still)
        for still in (False, True)
    )
    first, *others = standing.clip(0, 3, SIZE, SIZE)
    expected = walking.clip(0, 3, SIZE, SIZE)[0]
    np.testing.assert_allclose(first.world_to_camera, expected.world_to_camera, atol=1e-5)
    assert first.fx == expected.fx
    for camera in others:
        np.testing.assert_array_equal(camera.world_to_camera, first.world_to_camera)
    assert standing.model_copy(update={"cameras": walking.cameras}) == walking


def test_motion_that_is_damaged_is_told(filmed):
    *_, clips = filmed
    meta = clips[0][0]
    for changes, said in (
        ({"motion": "{}"}, "cannot be read"),
        ({"motion": Moving.of(meta).text().replace("iVBOR", "iVBOS")}, "cannot be read"),
    ):
        with pytest.raises(TronError, match=said):
            Moving.of(meta.model_copy(update={"extra": meta.extra | changes}))


def test_a_light_is_baked_once_a_clip_however_it_turns(variant, tmp_path, monkeypatch):
    spec, wanted = drawn(Share(lights=1.0), True), settings(tmp_path, width=8, height=8, path_spp=4)
    geometry = build(spec, edge=0.3)
    surfels, _ = make_surfels(spec, geometry, wanted)
    baked = []

    def count(light, *size):
        baked.append(light.family)
        return bake(light, *size)

    bake = Light.bake
    monkeypatch.setattr(Light, "bake", count)
    clips = [list(frames) for _, frames in make_clips(spec, geometry, surfels, wanted)]
    assert [len(frames) for frames in clips] == [3, 3]
    assert baked == ["studio", "overcast"]


@pytest.mark.parametrize("shared", [True, False])
def test_a_sun_that_turns_casts_the_shadows_of_where_it_has_come_to(shared, variant, tmp_path):
    spec, wanted = drawn(Share(lights=1.0), shared, ("sun",)), settings(tmp_path, lights=["sun"])
    geometry = build(spec, edge=0.2)
    surfels, _ = make_surfels(spec, geometry, wanted)
    ((meta, frames),) = ((meta, list(frames)) for meta, frames in make_clips(spec, geometry, surfels, wanted))
    camera, seen = Camera.from_dict(meta.cameras[-1]), frames[-1]["rgb"]
    errors = []
    for degrees in (spec.turns_deg[0], 0.0):
        light = spec.lights[0].bake(32).rotated(degrees)
        truth = render_frames(geometry.lit(light), [camera], 64, [3])[0]
        errors.append(
            np.abs(np.subtract(*(to_display(image, meta.exposure) for image in (seen, truth)))).mean()
        )
    assert errors[0] < 0.7 * errors[1]


def test_object_ids_are_those_of_the_geometry(variant):
    spec = drawn(Share(objects=1.0), True)
    geometry = build(spec, edge=0.3)
    number = FIRST_ID + len(spec.surroundings) + spec.motion.object
    item = spec.objects[spec.motion.object]
    surface = geometry.surfaces[0]
    faces = np.array(mi.traverse(surface.shape)["faces"]).reshape(-1, 3)
    which = np.unique(faces[surface.object_id == number])
    before = np.array(mi.traverse(surface.shape)["vertex_positions"]).reshape(-1, 3)
    geometry.move(number, spec.motion.pose(item, 1.0))
    after = np.array(mi.traverse(surface.shape)["vertex_positions"]).reshape(-1, 3)
    moved = np.abs(after - before).max(axis=1) > 1e-4
    np.testing.assert_array_equal(np.flatnonzero(moved), which)
    rise = after[which, 2] - before[which, 2]
    np.testing.assert_allclose(rise, spec.motion.lift, atol=1e-5)

"""Laws of a scene that can be lit: every part has the same settings, and what changes is as if made anew."""

from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians.edit import moved, subset
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.metering import incident_exposure
from tron.relighting import Guidance, Illumination, Relighter, views_under
from tron.relighting.proxy import Choice
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import render_guidance
from tron.shading.lighting import Lighting
from tron.tracing import SurfelTracer

VIEWS = [
    Camera.look_at((3 * np.cos(turn), 3 * np.sin(turn), 1.5), (0, 0, 0.4), fov_deg=40, width=32, height=32)
    for turn in (0.0, 2.0, 4.0)
]
BALL, SPACING = 1, 0.06


@pytest.fixture(scope="module")
def light() -> EnvironmentMap:
    """A dim sky with a bright patch low in the +x direction."""
    image = np.full((32, 64, 3), 0.3, np.float32)
    image[8:11, 14:17] = 60.0
    return EnvironmentMap(image)


@pytest.fixture(scope="module")
def scene(dense_surfels) -> GaussianScene:
    """A reddish ball, part metal, on a grey floor."""
    floor, ball = dense_surfels.plane(SPACING, 1.5), dense_surfels.sphere(SPACING, 0.5, 0.5)
    which = np.repeat([0, BALL], [len(floor.points), len(ball.points)])
    return dense_surfels.scene(
        floor, ball, spacing=SPACING, object_id=which, metallic=0.6 * which, roughness=0.8 - 0.5 * which,
        base_color=np.where(which[:, None] == BALL, [0.8, 0.3, 0.2], 0.5),
        log_scales=np.full((len(which), 2), np.log(0.4 * SPACING)),
    )  # fmt: skip


def without_sign(scene: GaussianScene) -> GaussianScene:
    """The scene with half of its surfels turned over, and not saying which."""
    over = generator(0, "tests", "over").random(len(scene)) < 0.5
    return replace(scene.turned_over(over), oriented=False)


def by_hand(
    scene: GaussianScene, cameras: list[Camera], light: EnvironmentMap, estimation: Estimation
) -> Iterator[Guidance]:
    """A frame of each camera, every part of it made by itself and given the settings by itself."""
    tracer, lighting = SurfelTracer(scene).sided(estimation.two_sided), Lighting(light)
    bounce = None
    if estimation.bounces:
        bounce = BounceTransport.trace(tracer, seed=5).bake(lighting, estimation, seed=5)
    for seed, camera in enumerate(cameras):
        yield render_guidance(tracer, camera, lighting, estimation, seed, bounce=bounce)


def assert_same(one: Guidance, other: Guidance) -> None:
    for name in Guidance.BUFFERS:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@pytest.mark.parametrize(
    "two_sided", [True, pytest.param(False, marks=pytest.mark.long)], ids=["two-sided", "one-sided"]
)
def test_every_part_has_the_same_settings(scene, light, two_sided):
    """Sides, bounces, reflections: as of a fresh bake by hand; a clean scene has no proxy."""
    for bounces, reflections in ((0, 0), (1, 0), (4, 0), (4, 2)):
        estimation = Estimation(rays=8, two_sided=two_sided, bounces=bounces, reflections=reflections)
        lit = Relighter(scene, estimation, 5).under(light)
        for seed, frame in enumerate(by_hand(scene, VIEWS[:2], light, estimation)):
            assert_same(lit.render(VIEWS[seed], seed), frame)


def test_surfels_without_a_sign_are_turned_to_each_camera_and_outward_to_light(scene, light):
    """Where light sees the scan itself: direct light of both sides, bounces of those that look outward."""
    blind, estimation = without_sign(scene), Estimation(rays=8)
    outward = blind.turned_over(~blind.looks_away(np.median(blind.means, axis=0)))
    bounce = BounceTransport.trace(SurfelTracer(outward), seed=5).bake(Lighting(light), estimation, seed=5)
    lit = Relighter(blind, estimation, 5, proxy="never").under(light)
    for seed, camera in enumerate(VIEWS[:2]):
        tracer = SurfelTracer(blind.facing(camera.position))
        truth = render_guidance(tracer, camera, Lighting(light), estimation, seed, bounce=bounce)
        ours = lit.render(camera, seed)
        np.testing.assert_allclose(ours.irradiance, truth.irradiance, atol=1e-3)
        error = np.abs(ours.indirect - truth.indirect).mean() / truth.indirect.mean()
        assert error < 0.01, f"relative error {error:.4f}"


def test_one_sided_surfels_send_no_light_out_of_their_backs(scene, light):
    """What two sides add where rays meet backs; that both halves are one-sided shows in the frame."""
    one, both = (
        Relighter(scene, Estimation(rays=8, two_sided=two_sided)).under(light) for two_sided in (False, True)
    )
    backs = [np.array(lit.relighter.transport.rays.met) % 2 for lit in (one, both)]
    missed = np.array(one.relighter.transport.rays.met) == np.uint32(0xFFFFFFFF)
    assert not (backs[0].astype(bool) & ~missed).any()
    assert one.relighter.transport.undersides is None


def indirect(lit: Illumination, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Indirect irradiance where the view sees surfels, and where that is."""
    guidance = lit.render(view)
    return guidance.indirect, guidance.mask > 0.9


@pytest.mark.usefixtures("short_film")
def test_normals_without_a_sign_get_the_light_of_the_side_that_a_camera_sees(light, scene):
    """Half of the surfels turned over: through a proxy every camera sees what it sees of the signed scene."""
    known, found = Relighter(scene).under(light), Relighter(without_sign(scene)).under(light)
    for view in VIEWS:
        truth, inside = indirect(known, view)
        ours, also = indirect(found, view)
        both = inside & also
        assert both.sum() > 400
        # Of other rays, which are few: means of 8 x 8 pixels.
        ours, truth = (
            (image * both[..., None]).reshape(4, 8, 4, 8, 3).sum((1, 3)) for image in (ours, truth)
        )
        error = np.abs(ours - truth).sum() / truth.sum()
        assert error < 0.12, f"relative error {error:.3f}"


@pytest.mark.long
@pytest.mark.usefixtures("short_film")
def test_mirrors_show_the_light_of_the_side_that_they_see(light, scene):
    """A far side that no camera sees is seen in the mirror below it, by its own light."""
    metal = replace(
        scene, metallic=np.ones_like(scene.metallic), roughness=np.full_like(scene.roughness, 0.15)
    )
    means = []
    for each in (metal, replace(metal, oriented=False)):
        guidance = Relighter(each, Estimation(reflections=16)).under(light).render(VIEWS[0])
        means.append(guidance.lit[guidance.mask > 0.9].mean())
    assert means[1] == pytest.approx(means[0], rel=0.1)


def test_a_scene_without_bounces_bakes_nothing(light, scene, monkeypatch):
    monkeypatch.setattr(BounceTransport, "trace", None)
    lit = Relighter(scene, Estimation(bounces=0)).prepare().under(light)
    assert lit.bounced is None
    guidance = lit.render(VIEWS[0])
    np.testing.assert_array_equal(guidance.lit, guidance.shadowed)


def test_one_tracer_serves_all_cameras_where_sides_are_known(variant, scene):
    relighter = Relighter(scene)
    assert relighter.tracer(VIEWS[0]) is relighter.tracer(VIEWS[1])
    relighter = Relighter(without_sign(scene), proxy="never")
    assert relighter.tracer(VIEWS[0]) is relighter.tracer(replace(VIEWS[0]))
    assert relighter.tracer(VIEWS[0]) is not relighter.tracer(VIEWS[1])


def test_frames_of_other_rays_share_a_bake(light, scene):
    lit = Relighter(scene, Estimation(rays=8)).under(light)
    finest = lit.framed(rays=16, reflections=2, supersample=2)
    assert finest.bounced is lit.bounced
    wanted = Estimation(rays=16, reflections=2, supersample=2)
    assert finest.estimation == wanted
    assert_same(finest.render(VIEWS[0]), Relighter(scene, wanted).under(light).render(VIEWS[0]))
    with pytest.raises(ValueError, match="bounces"):
        Relighter(scene, Estimation(bounces=0)).under(light).framed(reflections=2)


def test_a_turned_light_is_the_light_turned(light, scene):
    relighter = Relighter(scene, Estimation(rays=8))
    turned, alone = relighter.under(light).turned_to(90), relighter.under(light.rotated(90))
    assert_same(turned.render(VIEWS[0]), alone.render(VIEWS[0]))


def test_views_under_many_lights_are_those_under_each(light, scene):
    relighter = Relighter(scene, Estimation(rays=8))
    lights = [relighter.under(light, seed) for seed in (1, 2)]
    for lit, view in zip(lights, views_under(lights, VIEWS[1]), strict=True):
        assert_same(lit.render(VIEWS[1], view=view), lit.render(VIEWS[1]))


CHANGES = {
    "moved": lambda scene: moved(scene, scene.object_id == BALL, translation=np.array([0.3, -0.2, 0.1])),
    "painted": lambda scene: replace(scene, base_color=1 - scene.base_color),
    "thinned": lambda scene: replace(scene, opacity_logits=scene.opacity_logits - BALL * 3),
    "parted": lambda scene: subset(scene, scene.object_id == 0),
}


@pytest.mark.parametrize(
    ("change", "signed"),
    [
        ("moved", True),
        ("painted", True),
        *(
            pytest.param(*each, marks=pytest.mark.long)
            for each in (("thinned", True), ("parted", True), ("moved", False), ("parted", False))
        ),
    ],
)
def test_a_changed_scene_is_lit_as_if_it_were_new(light, scene, change, signed):
    """A frame to the noise of a bake, none where nothing has moved; rays to the bit, drawn in one order."""
    proxy: Choice = "auto" if signed else "never"
    before = Relighter(
        scene if signed else without_sign(scene), Estimation(rays=16), 3, proxy=proxy
    ).prepare()
    first = before.under(light).render(VIEWS[1])
    other = CHANGES[change](before.scene)
    found, fresh = before.changed(other), Relighter(other, Estimation(rays=16), 3, proxy=proxy)
    (ours, theirs) = (each.under(light) for each in (found, fresh))
    anew = BounceTransport.trace(found._light, seed=3)
    assert dr.all(found.transport.rays.met == anew.rays.met)
    ours, theirs = ours.render(VIEWS[1]), theirs.render(VIEWS[1])
    if change == "moved":
        error = np.abs(ours.lit - theirs.lit).mean() / theirs.lit.mean()
        assert error < 0.01, f"relative error {error:.4f}"
    else:
        assert_same(ours, theirs)
    assert_same(before.under(light).render(VIEWS[1]), first)


def test_other_materials_stand_under_the_light_that_was_baked_as_if_it_were_baked_anew(variant, light, scene):
    """Bitwise, where sums have an order: no shadow ray knows a material."""
    rtol = 0 if variant.startswith("llvm") else 1e-5  # a GPU adds in no fixed order
    before = Relighter(scene, Estimation(rays=0, filtered=True))
    baked = before.under(light)
    painted = replace(scene, base_color=0.5 * scene.base_color, metallic=1 - scene.metallic)
    found, anew = (
        before.bring(painted, baked.lighting, before=baked),
        Relighter(painted, before.estimation).under(light),
    )
    assert found.bounced is not None
    assert anew.bounced is not None
    for name in ("direct", "indirect", "outgoing", "behind", "openness"):
        np.testing.assert_allclose(
            getattr(found.bounced, name), getattr(anew.bounced, name), rtol=rtol, atol=0.1 * rtol
        )
    pictures = found.render(VIEWS[0]).lit, anew.render(VIEWS[0]).lit
    np.testing.assert_allclose(*pictures, rtol=rtol, atol=0.1 * rtol)
    assert np.abs(found.render(VIEWS[0]).lit - baked.render(VIEWS[0]).lit).max() > 0.05


def test_whatever_was_brought_before_what_is_brought_anew_is_that_of_a_new_relighter(variant, light, scene):
    """The law of random wishes: scenes, lights and turns in any order, looked at quickly or at rest."""
    rng, estimation = generator(0, "test", "bring"), Estimation(rays=0, filtered=True)
    first = Relighter(scene, estimation, proxy="never")
    scenes = [scene, *(CHANGES[name](scene) for name in ("painted", "moved", "parted"))]
    scenes.append(CHANGES["painted"](scenes[2]))
    lights = [Lighting(light), Lighting(EnvironmentMap.constant(0.5))]
    fresh, relighter, before, done = {}, first, None, []
    for _ in range(24):
        other, kind, turn = int(rng.integers(5)), int(rng.integers(2)), float(90 * rng.integers(2))
        quick = bool(rng.integers(2))
        start = first if other == 0 else relighter
        given = before
        before = start.bring(scenes[other], lights[kind], turn, before=before, quick=quick, anew=not quick)
        done.append(before is given)
        relighter = before.relighter
        assert relighter.scene is scenes[other]
        if quick:
            continue
        if (other, kind, turn) not in fresh:
            anew = Relighter(scenes[other], estimation, proxy="never").under(lights[kind].turned_to(turn))
            fresh[other, kind, turn] = anew.render(VIEWS[0]).lit
        rtol = 0 if variant.startswith("llvm") else 1e-5  # a GPU adds in no fixed order
        np.testing.assert_allclose(before.render(VIEWS[0]).lit, fresh[other, kind, turn], rtol=rtol)
    assert len(fresh) > 5
    again = relighter.bring(relighter.scene, lights[0], 0.0, before=before, anew=True)
    assert again.relighter.bring(again.relighter.scene, lights[0], 360.0, before=again) is again


def test_a_scan_with_a_proxy_stays_where_it_is_while_something_moves_quickly(light, scene):
    """Its proxy takes seconds; another paint does not."""
    first = Relighter(scene, Estimation(rays=0), proxy="always")
    before = first.under(light, quick=True)
    moving = first.bring(CHANGES["moved"](scene), before.lighting, before=before, quick=True)
    assert moving is before
    painted = first.bring(CHANGES["painted"](scene), before.lighting, before=before, quick=True)
    assert painted.relighter is not first
    assert painted.relighter.proxy is not None


def test_surfels_that_have_moved_are_baked_anew(light, scene):
    before = Relighter(scene, Estimation(rays=0))
    other = before.changed(moved(scene, scene.object_id == BALL, None, np.array([0.3, 0, 0])))
    first = before.under(light)
    found, anew = other.bring(other.scene, first.lighting, before=first), other.under(light)
    np.testing.assert_array_equal(found.render(VIEWS[0]).lit, anew.render(VIEWS[0]).lit)


def test_a_quick_bake_is_the_same_light_with_more_noise(light, scene):
    relighter = Relighter(scene, Estimation(rays=0, filtered=True))
    full, quick = (relighter.under(light, quick=each).render(VIEWS[0]) for each in (False, True))
    exposure = full.exposure()
    one, other = (to_display(each.lit, exposure)[full.mask > 0.5] for each in (full, quick))
    assert 30 < -10 * np.log10(np.square(one - other).mean()) < 60
    np.testing.assert_allclose(other.mean(), one.mean(), rtol=0.02)


def test_what_moves_quickly_is_lit_where_it_is_and_traces_no_bounce(light, scene, monkeypatch):
    before = Relighter(scene, Estimation(rays=0, filtered=True)).prepare()
    there = moved(scene, scene.object_id == BALL, None, np.array([0.3, 0, 0]))
    exact = before.changed(there).under(light, quick=True).render(VIEWS[0])
    monkeypatch.setattr(BounceTransport, "moved", None)
    quick = before.changed(there, quick=True).under(light, quick=True).render(VIEWS[0])
    one, other = (to_display(each.lit, exact.exposure())[exact.mask > 0.5] for each in (exact, quick))
    np.testing.assert_array_equal(quick.gbuffer["position"], exact.gbuffer["position"])
    assert -10 * np.log10(np.square(one - other).mean()) > 30


def test_some_buffers_alone_are_those_of_the_frame(light, scene):
    lit = Relighter(scene, Estimation(rays=0, filtered=True)).under(light)
    frame = lit.trace(VIEWS[0], 3)
    whole = frame.shade()
    for name, image in frame.images(("lit", "irradiance", "indirect")).items():
        np.testing.assert_array_equal(image, whole[name])


def test_a_backdrop_stays_in_no_light_s_way_when_things_move(light, scene):
    behind = np.zeros(len(scene), bool)
    behind[scene.object_id == 0] = True
    before = Relighter(scene, Estimation(rays=8), backdrop=behind).prepare()
    there = moved(scene, scene.object_id == BALL, translation=np.array([0.0, 0.0, 0.2]))
    met = np.array(before.changed(there).transport.rays.met)
    hit = (met[met != np.uint32(0xFFFFFFFF)] & 0x7FFFFFFF) // 2  # without the mark of a sheet's own
    assert hit.size
    assert not behind[hit].any()
    with pytest.raises(TronError, match="backdrop"):
        before.changed(subset(scene, ~behind))


def test_frames_are_written_as_pictures_and_as_light(light, scene, tmp_path):
    frame = Relighter(scene, Estimation(rays=8)).under(light.rotated(30)).render(VIEWS[0])
    frame.write(tmp_path / "lit.png")
    shown = read_image(tmp_path / "lit.png")
    metered = incident_exposure(frame, light.rotated(30).unoccluded(-VIEWS[0].forward), "photograph")
    assert frame.exposure() == pytest.approx(metered, rel=1e-4)
    expected = to_display(frame.lit, metered, look="photograph")
    np.testing.assert_allclose(shown, expected, atol=0.5 / 255 + 1e-4)
    frame.write(tmp_path / "pbr.png", "pbr", exposure=2.0, look="none")
    shown = read_image(tmp_path / "pbr.png")
    np.testing.assert_allclose(shown, to_display(frame.pbr, 2.0), atol=0.5 / 255 + 1e-6)
    frame.write(tmp_path / "lit.exr")
    np.testing.assert_allclose(read_image(tmp_path / "lit.exr"), frame.lit, rtol=1e-3)
    frame.write(tmp_path / "mask.png", "mask")
    shown = read_image(tmp_path / "mask.png")
    np.testing.assert_allclose(shown.reshape(32, 32, -1)[..., 0], frame.mask, atol=0.5 / 255 + 1e-6)
    with pytest.raises(KeyError):
        frame.write(tmp_path / "none.png", "none")


@pytest.mark.long
def test_a_denoised_frame_is_nearer_to_many_rays_and_keeps_what_has_no_noise(light, scene):
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    lit = Relighter(scene, Estimation(rays=2)).under(light)
    camera = VIEWS[0].resized(96, 96)
    truth, noisy = lit.framed(rays=512, supersample=2).render(camera, 1), lit.render(camera)
    clean = lit.render(camera, denoise="oidn")
    for name in set(Guidance.BUFFERS) - {"lit"}:
        np.testing.assert_array_equal(clean[name], noisy[name], err_msg=name)
    empty = noisy.mask == 0
    assert empty.any()
    np.testing.assert_array_equal(clean.lit[empty], noisy.lit[empty])
    shown = [to_display(frame.lit, 1.0)[noisy.mask > 0.9] for frame in (clean, noisy, truth)]
    errors = [np.square(each - shown[2]).mean() for each in shown]
    assert errors[0] < 0.3 * errors[1]
    assert_same(lit.render(camera, denoise="oidn"), clean)
    over_black = lit.render(camera, background=(0, 0, 0), denoise="oidn")
    behind = noisy.lit - lit.render(camera, background=(0, 0, 0)).lit
    np.testing.assert_allclose(clean.lit, over_black.lit + behind, atol=1e-5)


def test_without_bounces_shadowed_is_denoised_too(light, scene):
    """Then it is the relit picture, and the same as lit."""
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    lit = Relighter(scene, Estimation(rays=2, bounces=0)).under(light)
    clean = lit.render(VIEWS[0], denoise="oidn")
    np.testing.assert_array_equal(clean.shadowed, clean.lit)
    assert np.abs(clean.lit - lit.render(VIEWS[0]).lit).max() > 0.01

"""Laws of the proxy for light: thick scans have one, their surface; clean scenes stay as they are."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.gaussians.edit import moved
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.relighting import Guidance, Relighter, relighter
from tron.relighting.proxy import (
    THICK,
    ProxiedTracer,
    Proxy,
    evened,
    fingerprint,
    make_proxy,
    seen_by,
    thickness,
)
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer
from tron.tracing.hierarchy.transmittance import Fans

pytestmark = pytest.mark.usefixtures("variant")

VIEW = Camera.look_at((3, 0.4, 1.5), (0, 0, 0.4), fov_deg=40, width=48, height=48)
SPACING, LAYERS = 0.08, 4


@pytest.fixture(scope="module")
def clean(dense_surfels) -> GaussianScene:
    """A reddish ball of radius 0.5 on a grey floor."""
    floor, ball = dense_surfels.plane(SPACING, 1.5), dense_surfels.sphere(SPACING, 0.5, 0.5)
    which = np.repeat([0, 1], [len(floor.points), len(ball.points)])
    paint = np.where(which[:, None] == 1, [0.8, 0.3, 0.2], 0.5)
    return dense_surfels.scene(floor, ball, spacing=SPACING, object_id=which, base_color=paint)


@pytest.fixture(scope="module")
def fog(clean) -> GaussianScene:
    """The same as a scan has it: layers of thin splats over three spacings, normals that mean little."""
    rng, count = generator(0, "tests", "fog"), LAYERS * len(clean)
    every = np.tile(np.arange(len(clean)), LAYERS)
    deep = np.repeat(np.linspace(0.0, -3 * SPACING, LAYERS), len(clean)) + rng.normal(0, 0.5 * SPACING, count)
    values = {
        name: getattr(clean, name)[every]
        for name in vars(clean)
        if np.ndim(getattr(clean, name)) > 0 and len(getattr(clean, name)) == len(clean)
    }
    quats = values.pop("quats") + 0.5 * rng.normal(size=(count, 4))
    values |= {"quats": quats / np.linalg.norm(quats, axis=1, keepdims=True), "oriented": False}
    values["means"] = values["means"] + deep[:, None] * clean.normals()[every]
    values["opacity_logits"] = np.full(count, 0.5)
    return replace(clean, **values).turned_over(rng.random(count) < 0.5)


@pytest.fixture(scope="module")
def light() -> EnvironmentMap:
    image = np.full((32, 64, 3), 0.3, np.float32)
    image[4:8, 10:16] = 30.0
    return EnvironmentMap(image)


def test_the_number_tells_scans_from_clean_scenes(clean, fog):
    assert thickness(SurfelTracer(clean)) < 0.02
    assert thickness(SurfelTracer(fog)) > 2 * THICK
    nothing = replace(clean, opacity_logits=np.full(len(clean), -4.0))
    assert thickness(SurfelTracer(nothing)) == 0


@pytest.fixture(scope="module")
def proxy(fog) -> Proxy:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tron.relighting.proxy.VIEWS", 24)
        made = make_proxy(SurfelTracer(fog))
    assert made is not None
    return made


def test_the_proxy_is_one_layer_of_the_scans_surface_and_materials(proxy):
    """The median of the fog lies within its layers, and its normals are those of ball and floor."""
    surfels = proxy.surfels
    assert surfels.oriented
    assert thickness(SurfelTracer(surfels)) < 0.05
    from_middle = surfels.means - np.array([0, 0, 0.5])
    radius = np.linalg.norm(from_middle, axis=1)
    ball = (surfels.means[:, 2] > 0.2) & (radius < 0.8)
    assert ball.sum() > 200
    assert np.abs(radius[ball] - 0.5).max() < 4 * SPACING
    assert np.std(radius[ball]) < 0.5 * SPACING
    facing = (surfels.normals()[ball] * from_middle[ball]).sum(1) / radius[ball]
    assert np.degrees(np.arccos(np.clip(facing, -1, 1))).mean() < 10.5  # 12.1 as fused, 9.2 evened
    assert np.median(facing) > np.cos(np.radians(15))
    np.testing.assert_allclose(np.median(surfels.base_color[ball], 0), [0.8, 0.3, 0.2], atol=0.02)
    level = (np.linalg.norm(surfels.means[:, :2], axis=1) > 0.8) & (np.abs(surfels.means[:, :2]).max(1) < 1.3)
    level &= surfels.normals()[:, 2] > 0  # the fog is seen from below too
    assert np.median(surfels.normals()[level, 2]) > np.cos(np.radians(15))
    np.testing.assert_allclose(np.median(surfels.base_color[level], 0), 0.5, atol=0.02)


@pytest.mark.long
@pytest.mark.usefixtures("short_film")
def test_a_narrow_pit_is_closed(fog):
    """Behind gloss splats lie too deep here and there; light would see a well with black walls."""
    middle = np.array([1.0, 0.9])
    pit = np.linalg.norm(fog.means[:, :2] - middle, axis=1) < 0.15
    scan = replace(fog, means=fog.means - np.where(pit[:, None], [0, 0, 0.4], 0))
    made = make_proxy(SurfelTracer(scan))
    assert made is not None
    beside = np.linalg.norm(made.surfels.means[:, :2] - middle, axis=1) < 0.08
    assert beside.sum() > 3
    assert np.median(made.surfels.means[beside, 2]) > -3 * SPACING, "not as deep as the fog around it"


def specks(frame: Guidance, truth: Guidance) -> float:
    """Share of the pixels that truly get over 0.9 of their light which get under half."""
    solid = (frame.mask > 0.9) & (truth.mask > 0.9)
    share, true = ((each.irradiance / each.unshadowed).mean(-1) for each in (frame, truth))
    return float((share[solid & (true > 0.9)] < 0.5).mean())


def test_normals_that_wander_are_evened_and_edges_stay(dense_surfels):
    """On a cube: a third of the noise is left, and no face leans towards its neighbour."""
    box = dense_surfels.scene(dense_surfels.box())
    noise = generator(0, "tests", "wander").normal(0, 0.15, (len(box), 3))
    noisy = box.normals() + noise
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    even = evened(replace(box, quats=quats_from_normals(noisy))).normals()
    error = [np.degrees(np.arccos(np.clip((n * box.normals()).sum(1), -1, 1))).mean() for n in (noisy, even)]
    assert error[1] < error[0] / 3
    beside = np.sort(np.abs(box.means), axis=1)[:, 1] > 0.65  # of 0.7, where two faces meet
    assert np.degrees(np.arccos((even * box.normals()).sum(1)[beside])).mean() < error[0] / 2


@pytest.mark.usefixtures("short_film")
def test_a_thick_scan_is_lit_like_the_surface_it_is_of(clean, fog, light):
    """Against the clean scene: light that arrives is nearer to it, and no speck is left."""
    estimation = Estimation(rays=64)
    truth = Relighter(clean, estimation, proxy="never").under(light).render(VIEW)
    frames = {
        way: Relighter(fog, estimation, proxy=way).under(light).render(VIEW) for way in ("auto", "never")
    }
    solid = (truth.mask > 0.9) & (frames["never"].mask > 0.9)
    errors = {way: np.abs(frame.irradiance - truth.irradiance)[solid].mean() for way, frame in frames.items()}
    assert errors["auto"] < 0.5 * errors["never"]
    assert specks(frames["never"], truth) > 0.03
    assert specks(frames["auto"], truth) < 0.01
    for name in ("base_color", "opacity", "rgb", "depth"):  # the camera sees the scan
        np.testing.assert_array_equal(frames["auto"].gbuffer[name], frames["never"].gbuffer[name])


def test_a_clean_scene_is_the_same_with_and_without_asking(clean, light):
    frames = [
        Relighter(clean, Estimation(rays=8), proxy=way).under(light).render(VIEW) for way in ("auto", "never")
    ]
    for name in Guidance.BUFFERS:
        np.testing.assert_array_equal(frames[0][name], frames[1][name])


@pytest.fixture
def sheets(dense_surfels) -> tuple[GaussianScene, GaussianScene]:
    """A floor whose scan lies half a spacing too high and has a roof at 1; its proxy is the floor."""
    floor = dense_surfels.plane(SPACING, 1.0)
    lifted, roof = (replace(floor, points=floor.points + np.array([0, 0, z])) for z in (0.5 * SPACING, 1.0))
    scan = dense_surfels.scene(lifted, roof, spacing=SPACING, metallic=np.repeat([0.7, 0], len(floor.points)))
    return scan, dense_surfels.scene(floor, spacing=SPACING)


def test_a_pixel_lies_on_the_proxy_and_is_made_of_the_scan(sheets):
    scan, layer = sheets
    tracer = ProxiedTracer(SurfelTracer(scan), SurfelTracer(layer), voxel=SPACING)
    camera = Camera.look_at((2, 0, 0.6), (0, 0, 0), fov_deg=20, width=16, height=16)
    number = mi.Float(np.arange(len(layer), dtype=np.float32))
    found, plain = tracer.gbuffer(camera, [number]), SurfelTracer(layer).gbuffer(camera, [number])
    inside = np.array(plain.opacity) > 0.9
    assert inside.sum() > 60
    np.testing.assert_allclose(np.array(found.position)[2][inside], 0, atol=1e-5)
    np.testing.assert_allclose(np.array(found.values[0])[inside], np.array(plain.values[0])[inside])
    np.testing.assert_allclose(np.array(found.metallic)[inside], 0.7, atol=1e-5)
    # What the proxy does not have keeps its place, one spacing up; nearest surfels lend normals and values.
    above = tracer.gbuffer(
        Camera.look_at((0, 0, 3), (0, 0, 0), up=(0, 1, 0), fov_deg=10, width=8, height=8),
        [mi.Float(np.full(len(layer), 2.5, np.float32))],
    )
    np.testing.assert_allclose(np.array(above.position)[2], 1 + SPACING, atol=1e-4)
    np.testing.assert_allclose(np.array(above.values[0]), 2.5, rtol=1e-5)
    np.testing.assert_allclose(np.array(above.normal).T, np.tile([0, 0, 1.0], (64, 1)), atol=1e-4)


def test_a_hole_in_one_side_of_a_leaf_has_the_light_of_that_side(dense_surfels):
    """The far side is nearer to the splats behind the hole; what lies farther off lends nothing."""
    floor = dense_surfels.plane(SPACING, 1.0)
    leaf = dense_surfels.scene(floor, spacing=SPACING)
    thick = np.array([0, 0, 0.5 * SPACING])
    hole = np.hypot(*floor.points[:, :2].T) > 2 * SPACING
    under = replace(floor, points=(floor.points - thick)[hole], normals=-floor.normals[hole])
    upper = replace(floor, points=floor.points + 0.2 * thick)
    layer = dense_surfels.scene(upper, under, spacing=SPACING)
    value = mi.Float(np.repeat([5.0, 1.0], [len(upper.points), len(under.points)]).astype(np.float32))
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), up=(0, 1, 0), fov_deg=2, width=8, height=8)
    scan = SurfelTracer(leaf.turned_over(leaf.looks_away(camera.position)))
    for voxel, lent in ((SPACING, 1.0), (0.1 * SPACING, 5.0)):
        found = ProxiedTracer(scan, SurfelTracer(layer), voxel).gbuffer(camera, [value])
        np.testing.assert_allclose(np.array(found.values[0]), lent, rtol=1e-5)
        assert np.array(found.normal)[2].max() < -0.9


def test_shadows_beyond_some_voxels_are_the_scans_too(sheets):
    """The roof is nobody's but the scan's: seen from farther below than 4 voxels it shadows, nearer not."""
    scan, layer = sheets
    upwards, every = mi.Vector3f(0, 0, 1), mi.Bool(True)
    for voxel, shadowed in ((0.2, True), (0.3, False)):
        tracer = ProxiedTracer(SurfelTracer(scan), SurfelTracer(layer), voxel=voxel)
        (found,) = tracer.transmittances(Fans(mi.Point3f(0.01, 0.02, 0.001), [upwards], [every]))
        assert (float(found[0]) < 0.5) == shadowed


def test_a_proxy_is_kept_until_its_scan_changes(proxy, fog, tmp_path):
    path, made_from = tmp_path / "scan.proxy.ply", fingerprint(fog, None)
    proxy.save(path, made_from)
    back = Proxy.load(path, made_from)
    assert back is not None
    assert back.voxel == proxy.voxel
    np.testing.assert_allclose(back.surfels.means, proxy.surfels.means)
    other = replace(fog, base_color=1 - fog.base_color)
    assert Proxy.load(path, fingerprint(other, None)) is None
    assert Proxy.load(path, fingerprint(fog, [VIEW])) is None
    assert Proxy.load(tmp_path / "none.ply", made_from) is None
    path.write_bytes(path.read_bytes()[:5000])
    assert Proxy.load(path, made_from) is None


@pytest.mark.usefixtures("short_film")
def test_a_kept_proxy_is_not_filmed_again(fog, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    path, filmed = tmp_path / "scan.proxy.ply", []

    def films(views: range) -> range:
        filmed.append(len(views))
        return views

    first = Relighter(fog, proxy_file=path, filming=films).proxy
    assert filmed == [24]
    assert "thicker than a spacing" in caplog.text
    monkeypatch.setattr(relighter, "make_proxy", None)
    second = Relighter(fog, proxy_file=path).proxy
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first.surfels.means, second.surfels.means)


@pytest.mark.usefixtures("short_film")
def test_a_proxy_that_is_cut_off_says_that_it_begins_anew(fog, tmp_path):
    def ends(_):
        raise KeyboardInterrupt
        yield

    with pytest.raises(KeyboardInterrupt) as end:
        _ = Relighter(fog, proxy_file=tmp_path / "fog.proxy.ply", filming=ends).proxy
    assert "begins anew" in "".join(end.value.__notes__)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("short_film")
def test_a_file_that_cannot_be_written_stops_nothing(fog, tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "file").touch()
    assert Relighter(fog, proxy_file=Path(tmp_path / "file" / "scan.proxy.ply")).proxy is not None
    assert "not kept" in caplog.text


@pytest.mark.long
@pytest.mark.usefixtures("short_film")
def test_a_changed_scan_is_filmed_anew(fog, light):
    before = Relighter(fog, Estimation(rays=8), 3).prepare()
    changed = moved(fog, fog.object_id == 1, translation=np.array([0.0, 0.6, 0.0]))
    ours, fresh = before.changed(changed), Relighter(changed, Estimation(rays=8), 3)
    for name in Guidance.BUFFERS:
        one, other = (each.under(light).render(VIEW)[name] for each in (ours, fresh))
        np.testing.assert_array_equal(one, other)


@pytest.mark.long
@pytest.mark.usefixtures("short_film")
def test_paint_asks_for_no_film_and_no_ray(fog, light, monkeypatch):
    """And is lit as a scan that had it from the start, to the bit."""
    rng, estimation = generator(4, "tests", "paint"), Estimation(rays=0)
    color, roughness = rng.random((len(fog), 3), np.float32), rng.random(len(fog), np.float32)
    painted = replace(fog, base_color=color, roughness=roughness)
    fresh = Relighter(painted, estimation, 3).under(light).render(VIEW)
    before = Relighter(fog, estimation, 3).under(light)
    plain = before.render(VIEW)
    with monkeypatch.context() as nothing:
        nothing.setattr(relighter, "make_proxy", None)
        nothing.setattr(SurfelTracer, "first_hits", None)
        nothing.setattr(SurfelTracer, "transmittances", None)
        ours = before.relighter.bring(painted, before.lighting, before=before)
    for name in Guidance.BUFFERS:
        np.testing.assert_array_equal(ours.render(VIEW)[name], fresh[name])
    assert np.abs(fresh.lit - plain.lit)[plain.mask > 0.9].mean() > 0.01
    assert np.abs(fresh.indirect - plain.indirect)[plain.mask > 0.9].mean() > 1e-4, "the proxy is painted too"


def test_fog_that_shows_no_surface_is_lit_itself(clean, light, caplog):
    thin = replace(clean, opacity_logits=np.full(len(clean), -4.0), oriented=False)
    lit = Relighter(thin, Estimation(rays=8)).under(light)
    assert lit.relighter.proxy is None
    assert "no surface" in caplog.text
    assert np.isfinite(lit.render(VIEW).lit).all()


@pytest.mark.long
@pytest.mark.usefixtures("short_film")
def test_a_backdrop_is_no_part_of_the_proxy_and_faces_as_it_did(fog, dense_surfels):
    """A wall of sky behind the ball, turned to it."""
    sheet = dense_surfels.plane(SPACING, 1.0)
    turn = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])
    points, normals = sheet.points @ turn + np.array([-4, 0, 0.4]), sheet.normals @ turn
    wall = dense_surfels.scene(replace(sheet, points=points, normals=normals), spacing=SPACING)
    scene = joined(fog, wall)
    behind = np.arange(len(scene)) >= len(fog)
    lit = Relighter(scene, Estimation(rays=8), backdrop=behind)
    assert lit.proxy is not None
    assert lit.proxy.surfels.means[:, 0].min() > -2
    seen = lit.tracer(VIEW).gbuffer(Camera.look_at((3, 0, 1.2), (-4, 0, 1.2), fov_deg=2, width=8, height=8))
    depth = dr.norm(seen.position - mi.Point3f(3, 0, 1.2))
    far = np.array(depth) > 6
    assert far.sum() > 8
    np.testing.assert_allclose(np.array(seen.normal)[0][far], normals[0, 0], atol=0.02)


def joined(one: GaussianScene, other: GaussianScene) -> GaussianScene:
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "base_color", "roughness", "metallic",
             "object_id")  # fmt: skip
    return replace(one, **{n: np.concatenate([getattr(one, n), getattr(other, n)]) for n in names})


def test_cameras_of_the_photos_film_the_scan(fog, monkeypatch):
    """Some of many cameras, evenly, at most so large; the side that they see has surfels, the other none."""
    monkeypatch.setattr("tron.relighting.proxy.VIEWS", 8)
    monkeypatch.setattr("tron.relighting.proxy.SIDE", 96)
    turns = np.linspace(-0.6, 0.6, 30)
    cameras = [
        Camera.look_at((3 * np.cos(t), 3 * np.sin(t), 1.2), (0, 0, 0.4), fov_deg=40, width=960, height=640)
        for t in turns
    ]
    made = make_proxy(SurfelTracer(fog), cameras)
    assert made is not None
    ball = (made.surfels.means[:, 2] > 0.25) & (np.linalg.norm(made.surfels.means[:, :2], axis=1) < 0.6)
    assert (made.surfels.means[ball, 0] > -0.3).mean() > 0.95
    assert seen_by(SurfelTracer(fog), cameras[0]).width == 960

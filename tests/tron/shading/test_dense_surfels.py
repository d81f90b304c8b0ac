"""Laws of light on dense surfels of planes, spheres and boxes, against closed forms and Mitsuba itself."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.estimation import Estimation
from tron.gaussians.scene import measure_spacing
from tron.seeds import generator
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.tracing import SurfelTracer

SPACING = 0.05
VIEWS = [
    Camera.look_at(position, (0, 0, 0), fov_deg=35, width=48, height=48)
    for position in ((2.0, -3.0, 2.5), (-3.0, 1.0, -2.5), (3.0, 2.0, 0.3))
]


@pytest.fixture(scope="module")
def white(variant: str) -> Lighting:
    return Lighting(EnvironmentMap.constant(1.0))


def lights(sun_map: EnvironmentMap) -> dict[str, EnvironmentMap]:
    bands = generator(1, "tests", "bands").random((4, 8, 3)) * 3
    return {"sun": sun_map, "smooth": EnvironmentMap(bands.astype(np.float32)).resized(64)}


def away_from_silhouettes(guidance: Guidance) -> np.ndarray:
    """(H, W) bool: opaque, at no grazing angle, two pixels or more from any jump of depth or normal."""
    depth, normal = guidance.gbuffer["depth"], guidance.gbuffer["normal"]
    jump = np.array(guidance.mask < 0.99)
    for axis in (0, 1):
        for step in (1, -1):
            jump |= np.abs(np.roll(depth, step, axis) - depth) > 0.15
            jump |= (np.roll(normal, step, axis) * normal).sum(-1) < 0.9
    facing = -(normal * guidance.gbuffer["direction"]).sum(-1)
    near: np.ndarray = binary_dilation(jump, iterations=2)  # type: ignore[assignment]
    return (facing > 0.3) & ~near


def render_mitsuba(
    sheets: list[Any], view: Camera, light: EnvironmentMap, bsdf: dict[str, Any], spp: int
) -> np.ndarray:
    """Direct light on the shapes themselves: 2 ``spp`` emitter samples and as many of the BSDF a pixel."""
    sensor = {**mitsuba_sensor(view), "sampler": {"type": "independent", "sample_count": spp}}
    shapes = {f"shape{k}": {**sheet.mitsuba, "bsdf": bsdf} for k, sheet in enumerate(sheets)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "light": light.to_mitsuba(), **shapes})
    direct = mi.load_dict({"type": "direct", "emitter_samples": 2, "bsdf_samples": 2})
    return np.array(mi.render(scene, integrator=direct, spp=spp))


@pytest.mark.parametrize("shape", ["plane", "sphere", "box"])
def test_a_furnace_lights_dense_surfels_fully(dense_surfels, white, shape: str) -> None:
    tracer = SurfelTracer(dense_surfels.scene(getattr(dense_surfels, shape)()))
    for view in VIEWS[:1] if shape == "plane" else VIEWS:
        guidance = render_guidance(tracer, view, white, Estimation(rays=64))
        facing = -(guidance.gbuffer["normal"] * guidance.gbuffer["direction"]).sum(-1)
        seen = (guidance.mask > 0.99) & (facing > 0.3)
        assert seen.sum() > 300
        assert 0.98 <= guidance.irradiance[seen].mean() <= 1 + 1e-5
        inner = away_from_silhouettes(guidance)  # from a box's edges, too: within two spacings they are dark
        assert inner.sum() > 200
        assert np.quantile(guidance.irradiance[inner], 0.02) >= 0.98
        assert guidance.irradiance[inner].min() >= 0.9


@pytest.mark.parametrize(("spacing", "tilt"), [(0.2, 30.0), (0.05, 0.0), (0.05, 90.0), (0.05, 155.0)])
def test_sidedness_darkens_no_lit_plane(
    dense_surfels, white, points_gbuffer, spacing: float, tilt: float
) -> None:
    turn = Rotation.from_euler("xz", [tilt, 20], degrees=True).as_matrix()
    plane = dense_surfels.turned(dense_surfels.plane(spacing, 1.5), turn)
    tracer = SurfelTracer(dense_surfels.scene(plane, spacing=spacing))
    places = generator(0, "tests", "places").uniform(-0.9, 0.9, (500, 3)) * [1, 1, 0]
    for side in (1, -1):  # lit from behind, a sheet is two-sided but still darkens no point of its own
        gbuffer = points_gbuffer(places @ turn.T, np.tile(side * turn[:, 2], (500, 1)))
        shadowed, unshadowed = irradiance(tracer, gbuffer, white.light, 64, 0)
        np.testing.assert_allclose(np.array(shadowed), np.array(unshadowed), rtol=2e-3)


def uneven(plane: Any, spacing: float, degrees: float, height: float) -> Any:
    """A plane as reconstructions have it: normals off by some degrees, centres off by some of a spacing."""
    rng = generator(0, "tests", "uneven")
    shape = plane.points.shape
    normals = plane.normals + np.tan(np.radians(degrees)) * rng.normal(size=shape) * [1, 1, 0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = plane.points + spacing * rng.normal(size=shape) * [0.15, 0.15, height]
    return SimpleNamespace(points=points, normals=normals)


def test_coarse_surfels_beside_fine_ones_darken_little(dense_surfels, white) -> None:
    """The spacing of most surfels, which the scene's is, is a tenth of the plane's."""
    coarse, fine = 2.5 * SPACING, 0.25 * SPACING
    plane = uneven(dense_surfels.plane(coarse, 1.5), coarse, 5.0, 0.05)
    patch = dense_surfels.plane(fine, 0.5)
    patch = SimpleNamespace(points=patch.points + np.array([9.0, 0, 0]), normals=patch.normals)
    sizes = np.repeat([coarse, fine], [len(plane.points), len(patch.points)])
    scales = np.log(0.5 * sizes)[:, None].repeat(2, 1)
    scene = dense_surfels.scene(plane, patch, spacing=measure_spacing(patch.points), log_scales=scales)
    assert measure_spacing(scene.means) < 0.11 * coarse
    guidance = render_guidance(SurfelTracer(scene), VIEWS[0], white, Estimation(rays=64))
    inner = away_from_silhouettes(guidance)
    assert inner.sum() > 400
    assert guidance.irradiance[inner].mean() > 0.98


@pytest.mark.parametrize(
    ("degrees", "height", "least"), [(1.0, 0.0, 0.995), (3.0, 0.02, 0.99), (5.0, 0.05, 0.98)]
)
def test_uneven_surfels_darken_little(
    dense_surfels, white, degrees: float, height: float, least: float
) -> None:
    tracer = SurfelTracer(
        dense_surfels.scene(uneven(dense_surfels.plane(SPACING, 1.5), SPACING, degrees, height))
    )
    guidance = render_guidance(tracer, VIEWS[0], white, Estimation(rays=64))
    inner = away_from_silhouettes(guidance)
    assert inner.sum() > 400
    assert guidance.irradiance[inner].mean() > least


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_no_light_leaks_into_a_closed_object(dense_surfels, white, points_gbuffer, shape: str) -> None:
    tracer = SurfelTracer(dense_surfels.scene(getattr(dense_surfels, shape)()))
    rng = generator(0, "tests", "inside")
    # As near to the wall as back faces reach: two spacings, and what the offset takes.
    reach = {"sphere": (1.0 - 2.5 * SPACING) / np.sqrt(3), "box": 0.7 - 2.5 * SPACING}[shape]
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inside = points_gbuffer(rng.uniform(-reach, reach, (2000, 3)), normals)
    shadowed, unshadowed = irradiance(tracer, inside, white.light, 64, 0)
    assert np.array(unshadowed).min() > 0.5
    assert np.array(shadowed).mean() < 0.002
    assert np.array(shadowed).max() < 0.05


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_no_light_passes_through_a_closed_object(dense_surfels, shape: str) -> None:
    """Rays from outside that meet the shape itself, a spacing or more from its outline, are blocked."""
    tracer = SurfelTracer(dense_surfels.scene(getattr(dense_surfels, shape)()))
    rng = generator(0, "tests", "outside")
    d = rng.normal(size=(20000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    through = rng.uniform(-1, 1, (20000, 3))
    if shape == "sphere":
        nearest = through - (through * d).sum(1, keepdims=True) * d
        meets = np.linalg.norm(nearest, axis=1) < 1 - SPACING
    else:
        half = 0.7 - SPACING
        ends = np.stack([(-half - through) / d, (half - through) / d])
        meets = ends.min(0).max(1) < ends.max(0).min(1)
    origin = (through - 5 * d)[meets].astype(np.float32)
    seen = tracer.transmittance(
        mi.Point3f(origin.T.copy()), mi.Vector3f(d[meets].astype(np.float32).T.copy())
    )
    assert meets.sum() > 3000
    assert (np.array(seen) == 0).mean() > 0.999
    assert np.array(seen).max() < 0.05


def sun_alone() -> tuple[EnvironmentMap, np.ndarray]:
    """A sun of three degrees and nothing else; the horizontal unit direction (2,) that leads away from it."""
    image = np.zeros((128, 256, 3), np.float32)
    image[38:40, 60:62] = 2000
    azimuth = 61 / 256 * 2 * np.pi
    return EnvironmentMap(image), -np.array([np.sin(azimuth), np.cos(azimuth)])


@pytest.mark.parametrize("faces", ["closed", "towards the sun"])
def test_the_shadow_of_a_box_reaches_its_foot(dense_surfels, faces: str) -> None:
    """The umbra of Mitsuba's own cube is dark to within two pixels of the contact.

    Also where only the faces towards the sun exist, as in a capture from that side: there, back faces block.
    """
    sun, away = sun_alone()
    floor, box = dense_surfels.plane(half=2.5), dense_surfels.box(half=0.6, height=0.6)
    if faces != "closed":
        kept = (box.normals[:, :2] @ away < -1e-6) | (box.normals[:, 2] > 0.5)
        box = SimpleNamespace(points=box.points[kept], normals=box.normals[kept], mitsuba=box.mitsuba)
    scene = dense_surfels.scene(floor, box)
    aside = np.array([-away[1], away[0]])
    position = np.append(1.5 * away + 2.5 * aside, 2.6)
    view = Camera.look_at(position, np.append(0.5 * away, 0.3), fov_deg=38, width=96, height=96)
    white_bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    truth = render_mitsuba([floor, box], view, sun, white_bsdf, 32)[..., 0]
    # Where the camera looks past the cube and down on the floor, in closed form.
    d = view.rays().astype(np.float64)
    with np.errstate(divide="ignore"):
        ends = np.stack([((-0.6, -0.6, 0) - position) / d, ((0.6, 0.6, 1.2) - position) / d])
    hits_box = ends.min(0).max(-1) < ends.max(0).min(-1)
    on_floor = position + d * (-position[2] / d[..., 2:])
    sees_floor = ~hits_box & (d[..., 2] < 0) & (np.abs(on_floor[..., :2]) < 2.4).all(-1)
    dark = sees_floor & (truth < 1e-3 * truth.max())
    umbra: np.ndarray = binary_erosion(dark, np.ones((3, 3)), iterations=2)  # type: ignore[assignment]
    assert umbra.sum() > 500

    def lit(two_sided: bool) -> np.ndarray:
        estimation = Estimation(rays=64, two_sided=two_sided)
        guidance = render_guidance(SurfelTracer(scene), view, Lighting(sun), estimation)
        inside = umbra & (guidance.mask > 0.99)
        return guidance.irradiance[inside, 0] / guidance.unshadowed[inside, 0]

    assert lit(True).max() < 0.05
    if faces != "closed":
        assert lit(False).mean() > 0.5  # what one-sided surfels would let through: the test can fail


def test_the_shadow_of_a_ball_reaches_its_contact(dense_surfels, points_gbuffer, sun_map) -> None:
    """A ball resting on the floor, lit from one side: the floor just behind the contact is dark."""
    tracer = SurfelTracer(
        dense_surfels.scene(dense_surfels.plane(half=3.0), dense_surfels.sphere(height=1.0))
    )
    # The sun is at columns 30 and 31: away from it, from a tenth of the ball's radius to half of it.
    azimuth = 31 / 128 * 2 * np.pi
    away = -np.array([np.sin(azimuth), np.cos(azimuth)])
    distance = np.linspace(0.1, 0.5, 50)
    position = np.concatenate([distance[:, None] * away, np.zeros((50, 1))], 1)
    gbuffer = points_gbuffer(position, np.tile([0.0, 0, 1], (50, 1)))
    shadowed, unshadowed = irradiance(tracer, gbuffer, Lighting(sun_map).light, 256, 0)
    assert (np.array(shadowed)[1] / np.array(unshadowed)[1]).max() < 0.12


def sheets_of(dense: Any, name: str) -> list[Any]:
    if name == "ball on floor":
        return [dense.plane(half=3.0), dense.sphere(radius=0.7, height=0.75)]
    if name == "box on floor":
        return [dense.plane(half=3.0), dense.box(half=0.6, height=0.65)]
    return [getattr(dense, name)()]


VIEW = Camera.look_at((2.5, -3.2, 2.6), (0, 0, 0.3), fov_deg=35, width=48, height=48)


@pytest.mark.parametrize(
    ("shape", "light"),
    [
        *(("plane", "smooth"), ("sphere", "sun"), ("box", "smooth")),
        *(("ball on floor", "sun"), ("ball on floor", "smooth"), ("box on floor", "sun")),
    ],
)
def test_irradiance_is_that_of_mitsuba_on_the_shape_itself(
    dense_surfels, sun_map, shape: str, light: str
) -> None:
    """Within noise, plus a bias of at most 1.5% of the mean (what dense surfels darken near a contact)."""
    sheets, environment = sheets_of(dense_surfels, shape), lights(sun_map)[light]
    guidance = render_guidance(
        SurfelTracer(dense_surfels.scene(*sheets)), VIEW, Lighting(environment), Estimation(rays=128)
    )
    white_bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    truth = render_mitsuba(sheets, VIEW, environment, white_bsdf, 256)
    inner = away_from_silhouettes(guidance)
    ours, theirs = guidance.irradiance[inner], truth[inner]
    assert inner.sum() > 200
    assert np.abs(ours.mean(0) / theirs.mean(0) - 1).max() < 0.015
    assert np.median(np.abs(ours - theirs)) < 0.03 * theirs.mean()
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.07 * theirs.mean()


@pytest.mark.parametrize(
    ("shape", "metallic", "roughness", "light", "bias", "spread"),
    [
        ("box", 0.0, 0.3, "sun", 0.02, 0.04),
        ("sphere", 0.0, 0.3, "sun", 0.02, 0.04),
        ("plane", 0.0, 0.3, "smooth", 0.02, 0.05),
        ("sphere", 0.0, 0.7, "smooth", 0.05, 0.05),
        ("box", 1.0, 0.2, "smooth", 0.02, 0.04),
        ("sphere", 1.0, 0.5, "smooth", 0.04, 0.07),
    ],
)
def test_direct_light_is_that_of_the_path_tracers_material(
    dense_surfels,
    sun_map,
    shape: str,
    metallic: float,
    roughness: float,
    light: str,
    bias: float,
    spread: float,
) -> None:
    """Within noise plus the bias of split-sum, which takes view and normal for one.

    ``bias`` bounds the mean's, ``spread`` the median pixel's, relative to the mean. Rough metal under a sun
    is left out: there split-sum itself is off by half.
    """
    sheets, environment = sheets_of(dense_surfels, shape), lights(sun_map)[light]
    count = sum(len(sheet.points) for sheet in sheets)
    scene = dense_surfels.scene(
        *sheets,
        base_color=np.full((count, 3), 0.6),
        roughness=np.full(count, roughness),
        metallic=np.full(count, metallic),
    )
    guidance = render_guidance(SurfelTracer(scene), VIEW, Lighting(environment), Estimation(rays=64))
    bsdf = metallic_roughness(0.6, roughness, metallic)
    truth = render_mitsuba(sheets, VIEW, environment, bsdf, 128)
    inner = away_from_silhouettes(guidance)
    ours, theirs = guidance.shadowed[inner], truth[inner]
    assert abs(ours.mean() / theirs.mean() - 1) < bias
    assert np.median(np.abs(ours - theirs)) < spread * theirs.mean()

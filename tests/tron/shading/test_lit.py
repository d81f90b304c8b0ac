"""Laws of the whole picture: nothing where nothing bounces, a path tracer's where much does."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.estimation import FINEST, PREVIEW, Estimation
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.tracing import SurfelTracer

VIEW = Camera.look_at((2.2, -3.2, 1.5), (0, 0, 0.45), fov_deg=36, width=48, height=48)


def smooth() -> EnvironmentMap:
    bands = generator(1, "tests", "bands").random((4, 8, 3)) * 3
    return EnvironmentMap(bands.astype(np.float32)).resized(64)


def shown(scene: Any, environment: EnvironmentMap, estimation: Estimation, seed: int = 0) -> Guidance:
    tracer, lighting = SurfelTracer(scene), Lighting(environment)
    bounce = BounceTransport.trace(tracer).bake(lighting, estimation)
    return render_guidance(tracer, VIEW, lighting, estimation, seed, bounce=bounce)


def still_life(dense: Any, metal: bool) -> tuple[Any, list[dict[str, Any]]]:
    """A ball on a red floor before a blue box, as surfels and as Mitsuba's shapes; metal or diffuse."""
    sheets = [
        (dense.plane(half=2.0), (0.7, 0.25, 0.2), 0.6, 0.0),
        (dense.sphere(radius=0.5, height=0.5), (0.9, 0.8, 0.6), 0.25, float(metal)),
    ]
    box = dense.box(half=0.4, height=0.4)
    aside = np.array([-0.95, 0.3, 0.0])
    shape = {
        **box.mitsuba,
        "to_world": mi.ScalarTransform4f().translate(aside.tolist()) @ box.mitsuba["to_world"],
    }
    sheets.append((type(box)(box.points + aside, box.normals, shape), (0.2, 0.3, 0.8), 0.35, float(metal)))
    counts = [len(sheet.points) for sheet, *_ in sheets]
    scene = dense.scene(
        *[sheet for sheet, *_ in sheets],
        base_color=np.repeat([color for _, color, *_ in sheets], counts, axis=0),
        roughness=np.repeat([rough for *_, rough, _ in sheets], counts),
        metallic=np.repeat([metallic for *_, metallic in sheets], counts),
    )
    shapes = [
        {
            **sheet.mitsuba,
            "bsdf": metallic_roughness({"type": "rgb", "value": list(color)}, rough, metallic),
        }
        for sheet, color, rough, metallic in sheets
    ]
    return scene, shapes


def path_traced(shapes: list[dict[str, Any]], light: EnvironmentMap) -> np.ndarray:
    """(H, W, 3) linear radiance by Mitsuba's paths."""
    sensor = {**mitsuba_sensor(VIEW), "sampler": {"type": "multijitter", "sample_count": 1024}}
    named = {f"shape{k}": shape for k, shape in enumerate(shapes)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "light": light.to_mitsuba(), **named})
    integrator = mi.load_dict({"type": "path", "max_depth": 8, "rr_depth": 100})
    return np.array(mi.render(scene, integrator=integrator, spp=1024))[..., :3]


def error(picture: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """RMSE over the mean of the truth."""
    return float(np.sqrt(np.mean((picture - truth)[where] ** 2)) / truth[where].mean())


def test_without_a_bake_lit_is_shadowed(variant: str, dense_surfels) -> None:
    scene, _ = still_life(dense_surfels, metal=False)
    guidance = render_guidance(SurfelTracer(scene), VIEW, Lighting(smooth()), Estimation(rays=4))
    np.testing.assert_array_equal(guidance.lit, guidance.shadowed)
    assert guidance.indirect[guidance.mask > 0.999].max() == 0


@pytest.mark.parametrize(("shape", "reflections"), [("plane", 0), ("sphere", 8), ("box", 0), ("box", 8)])
def test_a_convex_object_alone_is_lit_as_if_nothing_bounced(
    dense_surfels, shape: str, reflections: int
) -> None:
    scene = dense_surfels.scene(getattr(dense_surfels, shape)())
    guidance = shown(scene, smooth(), Estimation(rays=16, reflections=reflections))
    inside = guidance.mask > 0.99
    assert inside.mean() > 0.1
    difference = np.abs(guidance.lit - guidance.shadowed)[inside]
    # At a box's edges the surfels of one face overhang another.
    most, mean = (0.6, 4e-3) if shape == "box" else (0.95, 1e-3)
    assert np.quantile(difference, most) < 1e-3 * guidance.shadowed[inside].mean()
    assert difference.mean() < mean * guidance.shadowed[inside].mean()


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("quality", ["preview", "final"])
def test_white_surfaces_all_but_vanish_in_a_furnace(
    dense_surfels, metallic: float, roughness: float, quality: str
) -> None:
    """What is white shines as even light does, and what hides the light as what it hides."""
    sheets = [dense_surfels.plane(half=1.5), dense_surfels.sphere(radius=0.4, height=0.5)]
    count = sum(len(sheet.points) for sheet in sheets)
    scene = dense_surfels.scene(
        *sheets,
        base_color=np.ones((count, 3)),
        roughness=np.full(count, roughness),
        metallic=np.full(count, metallic),
    )
    light, estimation = EnvironmentMap.constant(1.0), PREVIEW if quality == "preview" else FINEST
    # One ray a pixel of metal leaves noise of 0.003 in the mean of one frame, about 0.991 to 0.996.
    guidance, *others = [shown(scene, light, estimation, seed) for seed in range(4)]
    inside = guidance.mask > 0.99
    means = [frame.lit[inside].mean() for frame in (guidance, *others)]
    assert np.mean(means) == pytest.approx(1, abs=0.015)
    assert np.quantile(guidance.lit[inside], 0.99) <= 1.2  # shadows and bounces have noise of their own
    assert guidance.shadowed[inside].min() < 0.9 or metallic == 1


@pytest.mark.parametrize(("light", "metal"), [("sun", False), ("sun", True), ("smooth", True)])
def test_lit_is_what_mitsubas_path_tracer_shows(dense_surfels, sun_map, light: str, metal: bool) -> None:
    environment = smooth() if light == "smooth" else sun_map
    scene, shapes = still_life(dense_surfels, metal)
    truth = path_traced(shapes, environment)
    plain = shown(scene, environment, Estimation(rays=64))
    better = shown(scene, environment, Estimation(rays=64, reflections=32, supersample=2))
    inside = (plain.mask > 0.99) & (truth.max(-1) < np.quantile(truth, 0.99))
    errors = [error(picture, truth, inside) for picture in (plain.shadowed, plain.lit, better.lit)]
    means = [picture[inside].mean() / truth[inside].mean() for picture in (plain.lit, better.lit)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.8 * errors[1]
    assert errors[2] < 0.1
    assert means[1] == pytest.approx(1, abs=0.04)


def test_reflection_rays_find_what_a_mirror_shows(dense_surfels) -> None:
    """The metal ball alone: without rays it cannot know the floor below from the sky above."""
    scene, shapes = still_life(dense_surfels, metal=True)
    truth = path_traced(shapes, smooth())
    plain, better = (shown(scene, smooth(), Estimation(rays=64, reflections=n)) for n in (0, 64))
    ball = (plain.gbuffer["metallic"] > 0.99) & (plain.gbuffer["roughness"] < 0.3) & (plain.mask > 0.99)
    assert ball.sum() > 100
    before, after = (error(picture.lit, truth, ball) for picture in (plain, better))
    assert after < 0.3 * before


@pytest.mark.parametrize("background", [None, (0.0, 0.0, 0.0)])
def test_sub_pixels_are_a_finer_picture_averaged(dense_surfels, background) -> None:
    scene, _ = still_life(dense_surfels, metal=False)
    tracer, lighting = SurfelTracer(scene), Lighting(smooth())
    bounce = BounceTransport.trace(tracer).bake(lighting)
    many, few = Estimation(rays=16, reflections=8, supersample=2), Estimation(rays=4, reflections=2)
    ours = render_guidance(tracer, VIEW, lighting, many, 3, background, bounce)
    fine = render_guidance(tracer, VIEW.resized(96, 96), lighting, few, 3, background, bounce)

    def blocks(image: np.ndarray) -> np.ndarray:
        return image.reshape(48, 2, 48, 2, *image.shape[2:])

    for name in Guidance.BUFFERS:
        np.testing.assert_allclose(
            ours[name], blocks(fine[name]).mean((1, 3)), rtol=1e-5, atol=1e-6, err_msg=name
        )
    edge = (ours.mask > 0.05) & (ours.mask < 0.95)
    assert edge.any()
    opacity, base = blocks(fine.mask), blocks(fine.gbuffer["base_color"])
    weighted = (opacity[..., None] * base).sum((1, 3))[edge] / opacity.sum((1, 3))[edge, None]
    np.testing.assert_allclose(ours.gbuffer["base_color"][edge], weighted, rtol=1e-4)
    length = np.linalg.norm(ours.gbuffer["normal"], axis=-1)
    np.testing.assert_allclose(length[ours.mask > 0], 1, rtol=1e-5)
    np.testing.assert_allclose(ours.gbuffer["direction"], VIEW.rays(), atol=1e-4)
    depth, known = blocks(fine.gbuffer["depth"]), blocks(fine.gbuffer["depth"]) > 0
    nearest = np.where(known, depth, np.inf).min((1, 3))[known.any((1, 3))]
    found = ours.gbuffer["depth"][known.any((1, 3))]
    assert (found >= nearest * (1 - 1e-5)).all()  # pixels without a depth do not pull it to 0
    assert (found <= depth.max((1, 3))[known.any((1, 3))] * (1 + 1e-5)).all()


def test_the_same_seed_gives_the_same_bytes(dense_surfels) -> None:
    scene, _ = still_life(dense_surfels, metal=True)
    estimation = Estimation(rays=8, reflections=4, supersample=2)
    one, same, other = (shown(scene, smooth(), estimation, seed) for seed in (5, 5, 6))
    for name in Guidance.BUFFERS:
        np.testing.assert_array_equal(one[name], same[name], err_msg=name)
    assert (one.lit != other.lit).any()

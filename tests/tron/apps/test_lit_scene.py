"""Laws of the scene of a run: a light bounces in it as in the scene that the tracer of a camera has."""

from dataclasses import replace

import numpy as np
import pytest

from tron.apps.lit_scene import LitScene
from tron.cameras import Camera
from tron.estimation import FINAL
from tron.seeds import generator
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance

VIEWS = [
    Camera.look_at((3 * np.cos(turn), 3 * np.sin(turn), 1.5), (0, 0, 0.4), fov_deg=40, width=32, height=32)
    for turn in (0.0, 2.0, 4.0)
]


@pytest.fixture(scope="module")
def lighting(variant, light_path) -> Lighting:
    return Lighting(EnvironmentMap.load(light_path))


def indirect(lit: LitScene, lighting: Lighting, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Indirect irradiance where the view sees surfels, and where that is."""
    bounce = lit.bake(lighting)(view)
    guidance = render_guidance(lit.tracer(view), view, lighting, FINAL, bounce=bounce)
    return guidance.indirect, guidance.mask > 0.9


def test_normals_without_a_sign_get_the_light_of_the_side_that_a_camera_sees(lighting, ball_on_floor):
    """Half of the surfels turned over: every camera sees what it sees of the scene that knows its sides."""
    scene = ball_on_floor()
    over = generator(0, "tests", "over").random(len(scene)) < 0.5
    signless = replace(scene.turned_over(over), oriented=False)
    known, found = LitScene(scene, VIEWS[0], FINAL, 0), LitScene(signless, VIEWS[0], FINAL, 0)
    for view in VIEWS:
        truth, inside = indirect(known, lighting, view)
        ours, also = indirect(found, lighting, view)
        both = inside & also
        assert both.sum() > 400
        error = np.abs(ours - truth)[both].mean() / truth[both].mean()
        assert error < 0.1, f"relative error {error:.3f}"


def test_mirrors_show_the_light_of_the_side_that_they_see(lighting, ball_on_floor):
    """A far side that no camera sees is seen in the mirror below it, by its own light."""
    scene = ball_on_floor()
    metal = replace(
        scene, metallic=np.ones_like(scene.metallic), roughness=np.full_like(scene.roughness, 0.15)
    )
    estimation = FINAL.model_copy(update={"reflections": 16})
    means = []
    for each in (metal, replace(metal, oriented=False)):
        lit = LitScene(each, VIEWS[0], estimation, 0)
        bounce = lit.bake(lighting)(VIEWS[0])
        guidance = render_guidance(lit.tracer(VIEWS[0]), VIEWS[0], lighting, estimation, bounce=bounce)
        means.append(guidance.lit[guidance.mask > 0.9].mean())
    assert means[1] == pytest.approx(means[0], rel=0.05)


def test_without_bounces_lit_is_shadowed_whatever_was_baked(lighting, ball_on_floor):
    lit = LitScene(ball_on_floor(), VIEWS[0], FINAL, 0)
    bounce = lit.bake(lighting)(VIEWS[0])
    direct = FINAL.model_copy(update={"bounces": 0})
    guidance = render_guidance(lit.tracer(VIEWS[0]), VIEWS[0], lighting, direct, bounce=bounce)
    np.testing.assert_array_equal(guidance.lit, guidance.shadowed)


def test_a_scene_without_bounces_bakes_nothing(lighting, ball_on_floor):
    lit = LitScene(ball_on_floor(), VIEWS[0], FINAL.model_copy(update={"bounces": 0}), 0)
    assert lit.bake(lighting)(VIEWS[0]) is None


def test_one_tracer_serves_all_cameras_where_sides_are_known(variant, ball_on_floor):
    scene = ball_on_floor()
    for bounces in (0, 3):
        lit = LitScene(scene, VIEWS[0], FINAL.model_copy(update={"bounces": bounces}), 0)
        assert lit.tracer(VIEWS[0]) is lit.tracer(VIEWS[1])
    lit = LitScene(replace(scene, oriented=False), VIEWS[0], FINAL, 0)
    assert lit.tracer(VIEWS[0]) is lit.tracer(VIEWS[0])
    assert lit.tracer(VIEWS[0]) is not lit.tracer(VIEWS[1])

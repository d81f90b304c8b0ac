"""Kernels are compiled once: another view, light or scene of a kind brings none.

Kernels are told apart by the hash of their code, which no cache of an earlier run can hide.
"""

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from datagen.dataset.records import Work
from datagen.files.sources import Sources
from datagen.photographs.perfect import captured
from datagen.settings.captures import CaptureSettings
from datagen.settings.command import Settings
from datagen.sources.synthetic import make_scene
from datagen.truth.build import Geometry, build
from datagen.truth.pathtrace import direct_irradiance, gbuffers, render_frames, render_lights, stacked_lights
from datagen.world.lights import FAMILIES, Family
from datagen.world.scene import draw_scene
from datagen.world.styles import Choice
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.runtime import ALIGNMENT
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Lighting

pytestmark = pytest.mark.usefixtures("variant")


def kernels_of(action: Callable[[], object]) -> set[str]:
    """Hashes of the kernels that an action launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        return {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}


def geometry(index: int) -> Geometry:
    lights: list[Family] = ["overcast"]
    spec = draw_scene(
        0,
        "test",
        index,
        style="object",
        lights=lights,
        frames=1,
        path_frames=4,
        choice=Choice(objects=(2, 2)),
    )
    return build(spec, edge=0.2)


def camera(angle: float, fov: float = 34.0, size: int = 16) -> Camera:
    position = (4 * np.cos(angle), 4 * np.sin(angle), 2.5)
    return Camera.look_at(position, (0, 0, 0.3), fov_deg=fov, width=size, height=size)


def light(number: int, rotation: float) -> EnvironmentMap:
    return FAMILIES["studio"].draw(generator(0, "kernels", number), []).bake(16).rotated(rotation)


@pytest.mark.parametrize(
    "shoot",
    [
        lambda meshes, scene, view, seed: direct_irradiance(meshes, scene, view, 8, seed),
        lambda meshes, scene, view, seed: gbuffers(meshes, [view]),
        lambda meshes, scene, view, seed: render_frames(scene, [view], 4, [seed]),
        lambda meshes, scene, view, seed: render_frames(scene, [view], 4, [seed], transparent=True),
        lambda meshes, scene, view, seed: render_lights(
            scene, stacked_lights([light(seed % 100 + k, 0.0) for k in range(3)]), view, 4, seed
        ),
    ],
    ids=["irradiance", "gbuffers", "frames", "transparent", "many lights"],
)
def test_another_view_seed_light_or_scene_is_traced_by_the_same_kernels(variant, shoot):
    meshes = geometry(0)
    scene = meshes.lit(light(0, 30.0))
    first = kernels_of(lambda: shoot(meshes, scene, camera(0.3), 5))
    assert first
    assert kernels_of(lambda: shoot(meshes, scene, camera(1.1), 2**31 + 7)) <= first, "view and seed"
    assert kernels_of(lambda: shoot(meshes, scene, camera(1.1, fov=41.0), 5)) <= first, "field of view"
    del scene
    scene = meshes.lit(light(1, 77.0))
    assert kernels_of(lambda: shoot(meshes, scene, camera(0.3), 5)) <= first, "light"
    del scene, meshes
    meshes = geometry(1)
    scene = meshes.lit(light(2, 121.0))
    assert kernels_of(lambda: shoot(meshes, scene, camera(0.7), 5)) <= first, "scene"


def test_the_number_of_rays_brings_no_kernel(variant):
    meshes = geometry(0)
    first = kernels_of(lambda: gbuffers(meshes, [camera(0.3)]))
    assert kernels_of(lambda: gbuffers(meshes, [camera(0.3), camera(2.0, size=25)])) <= first


def test_every_sum_of_irradiance_is_taken_in_one_pass_over_the_rays(variant):
    """One kernel finds the surfaces, one traces the shadow rays: not one a channel."""
    meshes = geometry(0)
    scene = meshes.lit(light(0, 30.0))
    direct_irradiance(meshes, scene, camera(0.3), 8, 1)
    assert len(kernels_of(lambda: direct_irradiance(meshes, scene, camera(0.3), 8, 1))) == 2


def test_another_light_is_prepared_by_the_same_kernels(variant):
    kept = []

    def prepared(number: int) -> set[str]:
        return kernels_of(lambda: kept.append(Lighting(light(number, 0.0))))

    prepared(0)  # the BRDF's table is made once
    first = prepared(1)
    for number in range(2, 10):  # NumPy's memory lies elsewhere each time
        assert prepared(number) <= first
    if variant.startswith("llvm"):
        texels = [lighting.light._texels.numpy() for lighting in kept]  # the very memory
        assert {array.ctypes.data % ALIGNMENT for array in texels} == {0}


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "hdri"])
def test_another_light_of_a_family_is_baked_by_the_same_kernels(variant, family):
    def baked(number: int) -> set[str]:
        return kernels_of(lambda: FAMILIES[family].draw(generator(1, "kernels", number), []).bake(16))

    first = baked(0)
    for number in range(1, 8):
        assert baked(number) <= first


@pytest.mark.parametrize(
    "shared", [pytest.param(False, marks=pytest.mark.long), True], ids=["own paths", "shared path"]
)
def test_a_second_scene_of_a_split_brings_no_kernel(variant, shared, tmp_path: Path):
    """Surfels, their refinement, guidance, frames, references: all of a scene.

    Both scenes have an even number of surfels: an odd one brings three small kernels. None has metal, which
    brings some when it first mirrors metal.
    """
    tiny = [f"test.{key}" for key in ("frames=2", "width=16", "height=16", "path_spp=4", "reference_spp=4")]
    tiny += [
        f"test.lights_share_path={shared}",
        "test.style=object",
        "test.materials=[paint,marble,wood]",
        "test.lights=[studio,overcast]",
        "test.guidance_spp=2",
        "cluster=null",
        "path_frames=8",
    ]
    tiny += ["views=6", "view_width=32", "view_height=32", "surfels=1400", "refine_steps=6", "mesh_edge=0.2"]
    tiny += ["environment_height=16", "objects=[2,2]", f"output_dir={tmp_path}"]
    settings = check(compose_recipe("conf.datagen", Settings, tiny), Settings)

    def made(index: int) -> set[str]:
        item = Work("test", index, f"test-{index:06d}", first_shard=index)
        return kernels_of(lambda: make_scene(item, settings, Sources()))

    first = made(0)
    assert len(first) > 50
    assert made(1) <= first


def test_a_second_capture_brings_no_kernel(variant):
    settings = CaptureSettings.model_validate(
        {"views": 3, "width": 16, "height": 16, "path_spp": 4, "reference_spp": 4}
    )

    def shot(index: int) -> set[str]:
        families: list[Family] = ["studio"]
        spec = draw_scene(
            0,
            "test",
            index,
            style="object",
            lights=families,
            frames=1,
            path_frames=4,
            choice=Choice(objects=(2, 2)),
        )
        capture = captured(spec, build(spec, edge=0.2), spec.lights[0].bake(16).baked(), settings)
        return kernels_of(lambda: [view.read() for view in capture.views])

    first = shot(0)
    assert first
    assert shot(1) <= first

"""Script for Blender's Python: read a glTF, and render it by Cycles with given cameras and lights.

    PYTHON -I blender_process.py JOB.json

PYTHON has the wheel ``bpy`` (https://pypi.org/project/bpy), in an environment of its own. Frames
are EXR files of several layers, LIGHT_VIEW.exr beside the job: Combined (linear radiance, and alpha), Normal
(world) and the base color. The glTF comes to stand z up, as its importer has it.
"""

import json
import sys
from pathlib import Path
from typing import Any

import bpy  # pyright: ignore[reportMissingImports]


def main(job: str) -> None:
    """Render all frames of a job."""
    told: dict[str, Any] = json.loads(Path(job).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=told["model"])
    scene = bpy.context.scene
    _set_up(scene, told)
    for material in bpy.data.materials:
        if material.use_nodes:
            _prepare(material.node_tree, told["base_color"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    for light, path in enumerate(told["lights"]):
        _light(scene, path)
        for view, given in enumerate(told["cameras"]):
            camera.matrix_world = type(camera.matrix_world)(given["camera_to_world"])
            camera.data.sensor_fit, camera.data.sensor_width = "HORIZONTAL", 36.0
            camera.data.lens = 36.0 * given["focal"] / given["width"]
            camera.data.clip_start, camera.data.clip_end = 1e-3, 1e3
            scene.render.resolution_x, scene.render.resolution_y = given["width"], given["height"]
            scene.render.filepath = str(Path(job).parent / f"{light}_{view}.exr")
            bpy.ops.render.render(write_still=True)


def _set_up(scene: Any, told: dict[str, Any]) -> None:
    """Set up path tracing without denoising, clamping or smoothing; box filter, black background."""
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.seed = told["samples"], told["seed"]
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = told["bounces"]
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = 0.0
    scene.cycles.blur_glossy = scene.cycles.light_sampling_threshold = 0.0
    scene.render.film_transparent = True
    scene.render.resolution_percentage = 100
    scene.render.threads_mode, scene.render.threads = "FIXED", told["threads"]
    scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    scene.render.image_settings.color_depth = "32"
    layer = scene.view_layers[0]
    layer.name, layer.use_pass_normal = told["layer"], True
    layer.aovs.add().name = told["base_color"]


def _prepare(tree: Any, name: str) -> None:
    """Reduce a material to our model, and output its base color.

    Alpha above one half is opaque, below it is clear; there is no clear coat.
    """
    principled = next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None)
    if principled is None:
        return
    alpha, coat = principled.inputs["Alpha"], principled.inputs["Coat Weight"]
    if alpha.is_linked:
        cut = tree.nodes.new("ShaderNodeMath")
        cut.operation, cut.inputs[1].default_value = "GREATER_THAN", 0.5
        tree.links.new(alpha.links[0].from_socket, cut.inputs[0])
        tree.links.new(cut.outputs[0], alpha)
    else:
        alpha.default_value = round(alpha.default_value)
    for link in coat.links:
        tree.links.remove(link)
    coat.default_value = 0.0
    shown = tree.nodes.new("ShaderNodeOutputAOV")
    shown.aov_name = name
    taken = principled.inputs["Base Color"]
    if taken.is_linked:
        tree.links.new(taken.links[0].from_socket, shown.inputs["Color"])
    else:
        shown.inputs["Color"].default_value = taken.default_value


def _light(scene: Any, path: str) -> None:
    """Put a stored lat-long picture around the scene."""
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(path)
    picture.image.colorspace_settings.name = "Non-Color"
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    scene.world.cycles.sampling_method = "MANUAL"
    scene.world.cycles.sample_map_resolution = picture.image.size[0]


if __name__ == "__main__":
    main(*sys.argv[1:])

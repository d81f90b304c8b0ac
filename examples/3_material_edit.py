"""Change materials: the metal ring becomes blue plastic and the ball a mirror; before and after.

Of a scene of your own (--scene) every surfel becomes a rough metal.
"""

from dataclasses import replace

import numpy as np
from stage import BALL, RING, arguments, load_light, load_scene, look_at

from tron.color import to_display
from tron.images import write_image
from tron.shading import Estimation, Lighting, render_guidance
from tron.tracing import SurfelTracer

chosen = arguments(__doc__, "3_material_edit.jpg")
scene, light = load_scene(chosen), load_light(chosen)
lighting = Lighting(light)
base_color, roughness, metallic = scene.base_color.copy(), scene.roughness.copy(), scene.metallic.copy()
if chosen.scene is None:
    ring, ball = scene.object_id == RING, scene.object_id == BALL
    base_color[ring], roughness[ring], metallic[ring] = [0.03, 0.1, 0.6], 0.5, 0
    base_color[ball], roughness[ball], metallic[ball] = [0.9, 0.9, 0.9], 0.05, 1
else:
    roughness[:], metallic[:] = 0.4, 1
edited = replace(scene, base_color=base_color, roughness=roughness, metallic=metallic)

(camera,) = look_at(scene, chosen)
pictures = [
    render_guidance(SurfelTracer(each), camera, lighting, Estimation(rays=64)).shadowed
    for each in (scene, edited)
]
write_image(chosen.output, to_display(np.hstack(pictures), light.exposure()))
print(f"before and after: {chosen.output}")

"""Change materials: the metal ring becomes blue plastic and the ball a mirror; before and after.

Of a scene of your own (--scene) every surfel becomes a rough metal.
"""

from dataclasses import replace

import numpy as np

from examples.stage import BALL, RING, arguments, load_light, load_scene, look_at
from tron.color import to_display
from tron.io.images import write_image
from tron.relighting import Estimation, Relighter

chosen = arguments(__doc__, "edit_materials.jpg")
scene, light = load_scene(chosen), load_light(chosen)
base_color, roughness, metallic = scene.base_color.copy(), scene.roughness.copy(), scene.metallic.copy()
if chosen.scene is None:
    ring, ball = scene.object_id == RING, scene.object_id == BALL
    base_color[ring], roughness[ring], metallic[ring] = [0.03, 0.1, 0.6], 0.5, 0
    base_color[ball], roughness[ball], metallic[ball] = [0.9, 0.9, 0.9], 0.05, 1
else:
    roughness[:], metallic[:] = 0.4, 1
edited = replace(scene, base_color=base_color, roughness=roughness, metallic=metallic)

(camera,) = look_at(scene, chosen)
before = Relighter(scene, Estimation(rays=64, bounces=0))
after = before.changed(edited)  # nothing has moved: what rays meet is kept
pictures = [relighter.under(light).render(camera).lit for relighter in (before, after)]
write_image(chosen.output, to_display(np.hstack(pictures), light.exposure()))
print(f"before and after: {chosen.output}")

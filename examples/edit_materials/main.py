"""Change materials: the metal ring becomes blue plastic and the ball a mirror; before and after.

Of a scene of your own (--scene) every surfel becomes a rough metal.
"""

import numpy as np

from examples.stage import BALL, RING, arguments, load_light, load_scene, look_at
from tron.color import to_display
from tron.editing import Material, MaterialRange, Selection, Session
from tron.io.images import write_image
from tron.relighting import Estimation, Relighter

chosen = arguments(__doc__, "edit_materials.jpg")
scene, light = load_scene(chosen), load_light(chosen)
session = Session(scene)
if chosen.scene is None:
    ring, ball = Selection(object=RING), Selection(object=BALL)
    session.do(Material(select=ring, base_color=(0.03, 0.1, 0.6), roughness=0.5, metallic=0))
    session.do(Material(select=ball, base_color=(0.9, 0.9, 0.9), roughness=0.05, metallic=1))
else:
    everything = Selection(material=MaterialRange(roughness=(0, 1)))
    session.do(Material(select=everything, roughness=0.4, metallic=1))

(camera,) = look_at(scene, chosen)
# Rays that find what a mirror shows show the light that bounces there.
before = Relighter(scene, Estimation(rays=64, reflections=64, supersample=2))
after = before.changed(session.scene)  # nothing has moved: what rays meet is kept
pictures = [relighter.under(light).render(camera).lit for relighter in (before, after)]
write_image(chosen.output, to_display(np.hstack(pictures), light.exposure()))
print(f"before and after: {chosen.output}")

"""Load a scene and an environment map, and see the scene in that light, bounces included.

python -m examples.relight.main --scene scan.ply --environment studio.hdr
"""

from examples.stage import arguments, load_light, load_scene, look_at
from tron.relighting import Estimation, Relighter

chosen = arguments(__doc__, "relight.jpg")
scene, light = load_scene(chosen), load_light(chosen)
(camera,) = look_at(scene, chosen)
# The ball mirrors the sun that the ring mirrors: few rays find it, so many are sent.
relighter = Relighter(scene, Estimation(rays=64, reflections=256, supersample=2))
relighter.under(light).render(camera).write(chosen.output)
print(f"{len(scene)} surfels: {chosen.output}")

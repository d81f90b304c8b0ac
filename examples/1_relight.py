"""Load a scene and an environment map, and see the scene in that light.

python examples/1_relight.py --scene scan.ply --environment studio.hdr
"""

from stage import arguments, load_light, load_scene, look_at

from tron.color import to_display
from tron.images import write_image
from tron.shading import Estimation, Lighting, render_guidance
from tron.tracing import SurfelTracer

chosen = arguments(__doc__, "1_relight.jpg")
scene, light = load_scene(chosen), load_light(chosen)
(camera,) = look_at(scene, chosen)
picture = render_guidance(SurfelTracer(scene), camera, Lighting(light), Estimation(rays=64))
write_image(chosen.output, to_display(picture.shadowed, light.exposure()))
print(f"{len(scene)} surfels: {chosen.output}")

"""Load a scene and an environment map, and see the scene in that light, bounces included.

python examples/1_relight.py --scene scan.ply --environment studio.hdr
"""

from stage import arguments, load_light, load_scene, look_at

from tron.color import to_display
from tron.images import write_image
from tron.shading import BounceTransport, Estimation, Lighting, render_guidance
from tron.tracing import SurfelTracer

chosen = arguments(__doc__, "1_relight.jpg")
scene, light = load_scene(chosen), load_light(chosen)
(camera,) = look_at(scene, chosen)
tracer, lighting = SurfelTracer(scene), Lighting(light)
estimation = Estimation(rays=64, reflections=4, supersample=2)
bounce = BounceTransport.trace(tracer).bake(lighting, estimation)  # traced once a scene, baked once a light
picture = render_guidance(tracer, camera, lighting, estimation, bounce=bounce)
write_image(chosen.output, to_display(picture.lit, light.exposure()))
print(f"{len(scene)} surfels: {chosen.output}")

"""Film an orbit around the scene while the light turns the other way; a video, and six of its frames."""

import numpy as np
from stage import arguments, load_light, load_scene, look_at

from tron.color import to_display
from tron.images import write_image
from tron.shading import Estimation, Lighting, render_guidance
from tron.tracing import SurfelTracer
from tron.video import VideoWriter

chosen = arguments(__doc__, "2_orbit.jpg")
scene, light = load_scene(chosen), load_light(chosen)
cameras = look_at(scene, chosen, frames=6 if chosen.small else 48)
tracer, lighting, frames = SurfelTracer(scene), Lighting(light), []
with VideoWriter(chosen.output.with_suffix(".mp4"), 24, (cameras[0].width, cameras[0].height)) as video:
    for index, camera in enumerate(cameras):
        turned = lighting.turned_to(-360 * index / len(cameras))
        seen = render_guidance(tracer, camera, turned, Estimation(rays=16, filtered=True), seed=index)
        frames.append(to_display(seen.shadowed, light.exposure()))
        video.write(frames[-1])
sheet = [frame[::2, ::2] for frame in frames[:: len(frames) // 6]]
write_image(chosen.output, np.vstack([np.hstack(sheet[:3]), np.hstack(sheet[3:])]))
print(f"{len(frames)} frames: {chosen.output.with_suffix('.mp4')}")

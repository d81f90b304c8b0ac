"""Film an orbit around the scene while the light turns the other way; a video, and six of its frames."""

import numpy as np

from examples.stage import arguments, load_light, load_scene, look_at
from tron.color import to_display
from tron.io.images import write_image
from tron.io.video import VideoWriter
from tron.relighting import Estimation, Relighter

chosen = arguments(__doc__, "orbit.jpg")
scene, light = load_scene(chosen), load_light(chosen)
cameras = look_at(scene, chosen, frames=6 if chosen.small else 48)
relighter, frames = Relighter(scene, Estimation(rays=16, filtered=True, bounces=0)), []
lit, exposure = relighter.under(light), None
with VideoWriter(chosen.output.with_suffix(".mp4"), 24, (cameras[0].width, cameras[0].height)) as video:
    for index, camera in enumerate(cameras):
        seen = lit.turned_to(-360 * index / len(cameras)).render(camera, seed=index)
        exposure = exposure or seen.exposure()
        frames.append(to_display(seen.lit, exposure, look="photograph"))
        video.write(frames[-1])
sheet = [frame[::2, ::2] for frame in frames[:: len(frames) // 6]]
write_image(chosen.output, np.vstack([np.hstack(sheet[:3]), np.hstack(sheet[3:])]))
print(f"{len(frames)} frames: {chosen.output.with_suffix('.mp4')}")

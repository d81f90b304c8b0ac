"""Find the light of a scene from a few views: photos, and irradiance as a prior would estimate it.

The views are rendered here under a known light, so that the picture can show both: found left, true right.
"""

import numpy as np

from examples.stage import arguments, load_light, load_scene, look_at
from tron.captures import Capture, View
from tron.cli.progress import track
from tron.color import to_display
from tron.io.images import write_image
from tron.reconstruction import FitSettings, fit_environment
from tron.relighting import Estimation, Relighter

chosen = arguments(__doc__, "fit_light.jpg")
scene, light = load_scene(chosen), load_light(chosen)
lit, exposure, views = Relighter(scene, Estimation(rays=256, bounces=0)).under(light), light.exposure(), []
for index, camera in enumerate(look_at(scene, chosen, frames=6)):
    camera = camera.resized(96, 64)
    seen = lit.render(camera, seed=index)
    photo = to_display(seen.shadowed, exposure)
    views.append(View(f"{index}", camera, photo, "display", irradiance=seen.irradiance, mask=seen.mask))
settings = FitSettings(resolution=16, steps=60 if chosen.small else 400, rays=16, pixels=1024, scale_steps=20)
fit = fit_environment(Capture(tuple(views), exposure=exposure), scene, settings, track)
found = fit.environment.resized(light.image.shape[0])
both = to_display(np.hstack([found.image, light.image]), exposure)
write_image(chosen.output, both.repeat(2, axis=0).repeat(2, axis=1))
loss = fit.cubemap.loss
print(f"loss {loss[0]:.4f} -> {loss[-10:].mean():.4f}: {chosen.output}")

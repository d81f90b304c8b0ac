"""Maps of surfaces, whatever the light: base color, slope, roughness and metallic of each pixel.

Guidance under a light is sampled once a pixel, since shadow rays are dear; camera rays are not. These maps
are means over 2 x 2 sub-pixels, so that a network that is given them can tell a texture from noise and how
much of a pixel an edge covers.
"""

from __future__ import annotations

import numpy as np

from tron.cameras import Camera
from tron.shading.guidance import ViewTracer
from tron.shading.supersampling import averaged

SUB_PIXELS = 2
"""Sub-pixels along a pixel's side."""


def surface_maps(tracer: ViewTracer, camera: Camera) -> dict[str, np.ndarray]:
    """Members ``albedo`` and ``surface`` of one view, (H, W, 3) float32 in [0, 1], 0 where no surfels are.

    ``albedo`` is linear base color; the channels of ``surface`` are |n . v| of the unit normal and the unit
    direction to the camera, roughness and metallic. Each sub-pixel counts by its opacity.
    """
    fine = camera.resized(SUB_PIXELS * camera.width, SUB_PIXELS * camera.height)
    seen = tracer.gbuffer(fine).numpy()
    facing = np.abs((seen["normal"] * seen["direction"]).sum(-1))
    maps = {
        "albedo": seen["base_color"],
        "surface": np.stack([facing, seen["roughness"], seen["metallic"]], axis=-1),
    }
    opacity = seen["opacity"][..., None]
    return {name: averaged(np.clip(image, 0, 1) * opacity, SUB_PIXELS) for name, image in maps.items()}

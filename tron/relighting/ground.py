"""A ground plane that shows the environment, with the shadows of the subject on it.

A map is infinitely far, so what is lit by it floats before it. Here the map is projected from a point above
the plane, as high as the camera, onto the plane, the local scene of Debevec ("Rendering synthetic objects
into real scenes", 1998): the horizon stays where it is, and the ground keeps its place when the camera moves.
Each point of it shows what the map has there, times the share of light that arrives: the map was taken when
nothing stood there.

No light is sent up from the plane to the scene: the map's lower half does that, shadows or not. Nor does what
glows light the plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.framing import find_subject, foot_height, has_floor
from tron.gaussians.scene import GaussianScene
from tron.seeds import integer
from tron.shading.direct.visibility import Shadows, visibility
from tron.shading.lighting import Lighting
from tron.tracing import GBuffer

_LEAST_EYE = 0.3
"""Least height from which the map is projected, in radii of the subject: from lower, all is horizon."""


@dataclass(frozen=True)
class Ground:
    """A level plane, z up, that shows the environment.

    Attributes:
        height: z of the plane, world units.
        eye: (3,) point that the map is projected from, world.
    """

    height: float
    eye: tuple[float, float, float]

    def behind(
        self,
        tracer: Shadows,
        view: GBuffer,
        camera: Camera,
        lighting: Lighting,
        estimation: Estimation,
        seed: int,
    ) -> mi.Color3f:
        """Return linear radiance behind the surfels of a view: shadowed ground, and environment.

        Args:
            tracer: what casts shadows.
            view: of ``camera``, of sub-pixels or not.
            lighting: the prepared environment.
            estimation: of the light, as of the frame.
            seed: root of the frame's random numbers.
        """
        origin = mi.Point3f(*(float(v) for v in camera.position))
        height, eye = dr.opaque(mi.Float, self.height), mi.Point3f(*self.eye)
        dr.make_opaque(origin, eye)
        down = view.direction.z < 0
        distance = (height - origin.z) / dr.select(down, view.direction.z, -1)
        seen = down & (distance > 0) & (view.opacity < 1)
        met = mi.Point3f(dr.fma(distance, view.direction, mi.Vector3f(origin)))
        position = dr.select(seen, met, view.position)
        given = {field.name: getattr(view, field.name) for field in fields(GBuffer)}
        given |= {"position": position, "depth": dr.select(seen, distance, 0), "values": []}
        given |= {"opacity": dr.select(seen, mi.Float(1), 0)}
        given |= {"normal": mi.Normal3f(0, 0, dr.select(seen, 1, 0))}
        plane = GBuffer(**given)
        dr.eval(plane)
        share = visibility(tracer, plane, lighting, estimation.of_sub_pixel(), integer(seed, "ground"))
        outward = dr.select(seen, dr.normalize(position - eye), view.direction)
        radiance = lighting.light.radiance(mi.Vector3f(outward))
        return dr.select(seen, radiance * share, radiance)


GroundOf = Ground | Callable[[Camera], Ground | None] | None
"""The ground of a scene, None for no ground, or a function that gives it for a camera."""


@dataclass(frozen=True)
class Footing:
    """Subject and floor of a scene with z up: found once, for all cameras.

    Attributes:
        floor: whether the scene has a floor of its own.
        centre, radius: of the subject, world units.
        height: of the lowest surfels, without outliers.
    """

    floor: bool
    centre: np.ndarray
    radius: float
    height: float

    @classmethod
    def of(cls, scene: GaussianScene) -> Footing:
        """Find subject and floor of a scene with z up."""
        subject = find_subject(scene)
        height = foot_height(scene.means[:, 2], scene.opacity_logits)
        return cls(has_floor(scene), subject.centre, subject.radius, height)

    def free(self, cameras: Sequence[Camera]) -> bool:
        """Return whether the scene has no floor and all cameras stand outside the subject."""
        return not self.floor and all(
            camera.position[2] > self.height and np.linalg.norm(camera.position - self.centre) > self.radius
            for camera in cameras
        )

    def ground(self, camera: Camera, height: float | None = None) -> Ground:
        """Return the ground plane, with the environment projected from the height of a camera.

        Args:
            camera: the first of a clip.
            height: of the plane, world units; None: the lowest surfels'.
        """
        height = self.height if height is None else height
        rise = max(float(camera.position[2]) - height, _LEAST_EYE * self.radius)
        return Ground(height, (float(self.centre[0]), float(self.centre[1]), height + rise))

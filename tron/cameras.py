"""The pinhole camera and its conversions.

TRON's cameras are OpenCV's: x right, y down, z forward, world-to-camera matrices, intrinsics in pixels. The
pixel in column i and row j covers [i, i+1] x [j, j+1] and has its centre at (i + 0.5, j + 0.5). Other
conventions are converted once, where a file or a library is met:

- OpenGL, Blender, NeRF: x right, y up, z backward, camera-to-world;
- Mitsuba: x left, y up, z forward, camera-to-world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from tron.camera_record import CameraRecord
from tron.errors import TronError
from tron.framing import Surfels, find_subject, framed, outward

_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV <-> OpenGL
_FLIP_XY = np.diag([-1.0, -1.0, 1.0, 1.0])  # OpenCV <-> Mitsuba


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in the OpenCV convention.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels from the top left corner of the image; (width / 2, height / 2) is
            its centre.
        width, height: image size in pixels.
        world_to_camera: (4, 4) float64 rigid transform from world to OpenCV camera coordinates.

    Raises:
        TronError: sizes or focal lengths that are not positive, or a matrix that is not a rigid transform.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    world_to_camera: np.ndarray

    def __post_init__(self) -> None:
        matrix = np.array(self.world_to_camera, dtype=np.float64)  # a copy: the camera owns its matrix
        if matrix.shape != (4, 4):
            raise TronError(f"camera matrix must be 4 x 4, not {matrix.shape}")
        rotation = matrix[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
        if not (np.isfinite(matrix).all() and rigid and np.allclose(matrix[3], (0, 0, 0, 1))):
            raise TronError("camera matrix must be a rotation and a translation without scale or mirroring")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not (np.isfinite(intrinsics).all() and self.fx > 0 and self.fy > 0):
            raise TronError(f"camera intrinsics must be finite with positive focal lengths, not {intrinsics}")
        if self.width < 1 or self.height < 1:
            raise TronError(f"camera size must be positive, not {self.width} x {self.height}")
        matrix.flags.writeable = False
        object.__setattr__(self, "world_to_camera", matrix)

    @classmethod
    def look_at(
        cls,
        position: Sequence[float] | np.ndarray,
        target: Sequence[float] | np.ndarray,
        *,
        up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
        fov_deg: float,
        width: int,
        height: int,
    ) -> Camera:
        """Place a camera at ``position`` that sees ``target`` in the middle of its image, ``up`` pointing up.

        Args:
            position, target: (3,) world points.
            up: (3,) world direction, any length.
            fov_deg: horizontal field of view in degrees; pixels are square.
            width, height: image size in pixels.

        Raises:
            TronError: position and target coincide, the view runs along ``up``, or fov_deg is outside
                (0, 180).
        """
        if not 0 < fov_deg < 180:
            raise TronError(f"horizontal field of view must lie between 0 and 180 degrees, not {fov_deg}")
        origin = np.asarray(position, dtype=np.float64)
        forward = _unit(np.asarray(target, dtype=np.float64) - origin, "camera position and target coincide")
        right = _unit(
            np.cross(forward, np.asarray(up, dtype=np.float64)), "camera looks along its up direction"
        )
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ origin
        focal = 0.5 * width / math.tan(0.5 * math.radians(fov_deg))
        return cls(focal, focal, width / 2, height / 2, width, height, matrix)

    @classmethod
    def around(
        cls,
        scene: Surfels,
        *,
        azimuth_deg: float = 0.0,
        elevation_deg: float = 25.0,
        distance: float = 1.0,
        fov_deg: float = 40.0,
        width: int = 512,
        height: int = 512,
    ) -> Camera:
        """Place a camera from which a scene's subject fills the image, ``scene.up`` pointing up.

        What to look at and from how far is found as by ``tron-relight trajectory=still``.

        Args:
            scene: a :class:`tron.gaussians.GaussianScene`, upright or not.
            azimuth_deg: counter-clockwise about up seen from its tip, from the world's x axis.
            elevation_deg: above the level plane, within (-90, 90).
            distance: factor on the distance that is found.
            fov_deg: horizontal field of view in degrees.
            width, height: image size in pixels.

        Raises:
            TronError: fov_deg is outside (0, 180), or the camera looks along up.
        """
        if not 0 < fov_deg < 180:
            raise TronError(f"horizontal field of view must lie between 0 and 180 degrees, not {fov_deg}")
        subject = find_subject(scene)
        (away,) = outward(np.array([azimuth_deg]), np.array([elevation_deg]), scene.up)
        image = {"fov_deg": fov_deg, "width": width, "height": height}

        def at(radius: float) -> list[Camera]:
            return [cls.look_at(subject.centre + radius * away, subject.centre, up=scene.up, **image)]

        return framed(subject, at, **image, distance=distance)[0]

    @cached_property
    def camera_to_world(self) -> np.ndarray:
        """(4, 4) float64 transform from OpenCV camera coordinates to the world."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.world_to_camera[:3, :3].T
        matrix[:3, 3] = -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]
        matrix.flags.writeable = False
        return matrix

    @property
    def position(self) -> np.ndarray:
        """(3,) float64 centre of projection in the world."""
        return self.camera_to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) float64 unit world direction of the optical axis, away from the camera."""
        return self.camera_to_world[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """(3,) float64 unit world direction that points up in the image."""
        return -self.camera_to_world[:3, 1]

    @property
    def intrinsics(self) -> np.ndarray:
        """(3, 3) float64 matrix K with ``pixel = K @ (x/z, y/z, 1)``."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view in degrees, off-centre principal points included."""
        return math.degrees(math.atan(self.cx / self.fx) + math.atan((self.width - self.cx) / self.fx))

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid: intrinsics scale with the image."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )

    def window(self, x: int, y: int, width: int, height: int) -> Camera:
        """Part of the view, its upper left pixel at (x, y) of this one's: the principal point moves."""
        return replace(self, cx=self.cx - x, cy=self.cy - y, width=width, height=height)

    def rays(self) -> np.ndarray:
        """Unit world directions (height, width, 3) float32 through the pixel centres, from ``position``."""
        return self.exact_rays().astype(np.float32)

    def exact_rays(self) -> np.ndarray:
        """:meth:`rays` in float64, for what may have no error but rounding."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        local = np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.camera_to_world[:3, :3].T

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (N, 3) to pixels (N, 2), x then y, and depths (N,) along the optical axis.

        Depths are z, not distances; points behind the camera have depth <= 0 and pixels without meaning.
        """
        local = (
            np.asarray(points, dtype=np.float64) @ self.world_to_camera[:3, :3].T
            + self.world_to_camera[:3, 3]
        )
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = local[:, :2] / depth[:, None] * (self.fx, self.fy) + (self.cx, self.cy)
        return pixels, depth

    def to_dict(self) -> CameraRecord:
        """Plain numbers and lists, for JSON; floats survive the round trip exactly."""
        return {
            "fx": float(self.fx),
            "fy": float(self.fy),
            "cx": float(self.cx),
            "cy": float(self.cy),
            "width": int(self.width),
            "height": int(self.height),
            "world_to_camera": self.world_to_camera.tolist(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Camera:
        """Inverse of :meth:`to_dict`; TronError names a missing or unreadable field."""
        try:
            return cls(
                fx=float(data["fx"]),
                fy=float(data["fy"]),
                cx=float(data["cx"]),
                cy=float(data["cy"]),
                width=int(data["width"]),
                height=int(data["height"]),
                world_to_camera=np.asarray(data["world_to_camera"], dtype=np.float64),
            )
        except KeyError as error:
            raise TronError(f"camera lacks the field {error.args[0]!r}") from error
        except (TypeError, ValueError) as error:
            raise TronError(f"camera has an unreadable field: {error}") from error


def _unit(vector: np.ndarray, complaint: str) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not length > 1e-12:
        raise TronError(complaint)
    return vector / length


def focus_of(cameras_to_world: Sequence[np.ndarray]) -> tuple[np.ndarray, bool]:
    """(3,) the point nearest to all optical axes, and whether these diverge.

    Nearest by least squares; in front of the cameras if the axes diverge.

    Args:
        cameras_to_world: (4, 4) matrices, OpenCV camera axes.
    """
    matrices = np.stack(cameras_to_world)
    origins, axes = matrices[:, :3, 3], matrices[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centre = origins.mean(0)
    spread = np.linalg.norm(origins - centre, axis=1).mean()
    # Parallel axes meet nowhere: a little pull towards a point before the cameras decides.
    ahead = centre + axes.mean(0) * spread
    pull = 1e-3 * len(origins)
    sums = np.einsum("nij,nj->i", across, origins) + pull * ahead
    point = np.linalg.solve(across.sum(0) + pull * np.eye(3), sums)
    in_front = np.einsum("ni,ni->n", point - origins, axes) > 0
    return (point, False) if in_front.mean() > 0.5 else (ahead, True)


def opengl_to_opencv(camera_to_world: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world (..., 4, 4) -> OpenCV camera-to-world (..., 4, 4); its own inverse."""
    return np.asarray(camera_to_world, dtype=np.float64) @ _FLIP_YZ


def opencv_to_opengl(camera_to_world: np.ndarray) -> np.ndarray:
    """OpenCV camera-to-world (..., 4, 4) -> OpenGL camera-to-world (..., 4, 4); its own inverse."""
    return np.asarray(camera_to_world, dtype=np.float64) @ _FLIP_YZ


def mitsuba_to_world(camera: Camera) -> np.ndarray:
    """(4, 4) float64 from Mitsuba's local camera frame (x left, y up, z forward) to the world."""
    return camera.camera_to_world @ _FLIP_XY


def mitsuba_sensor(camera: Camera, spp: int = 16, **film: Any) -> dict[str, Any]:
    """Describe a camera as a Mitsuba ``perspective`` sensor, for ``mi.load_dict``.

    The variant must be set before the call. The film is ``hdrfilm`` with a box filter, RGB in float32, unless
    ``film`` says otherwise. Mitsuba crops nothing and keeps one focal length, so pixels must be square.

    Args:
        camera: the camera; any principal point.
        spp: samples a pixel, of an ``independent`` sampler.
        film: more entries for the film, e.g. ``rfilter={"type": "gaussian"}``.

    Raises:
        TronError: fx and fy differ by more than one part in 10,000.
    """
    import mitsuba as mi

    if abs(camera.fx - camera.fy) > 1e-4 * camera.fx:
        raise TronError(
            f"Mitsuba's camera has square pixels, but fx = {camera.fx:g} and fy = {camera.fy:g}",
            mend="resize the images so that both focal lengths agree",
        )
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(0.5 * camera.width / camera.fx)),
        # Mitsuba counts how far the image lies from the principal point, not the reverse.
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        "near_clip": 1e-4,
        "far_clip": 1e6,
        "to_world": mi.ScalarTransform4f(mitsuba_to_world(camera).tolist()),
        "sampler": {"type": "independent", "sample_count": spp},
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
            **film,
        },
    }


def rigid_pose(matrix: object) -> np.ndarray:
    """(4, 4) float64 rigid transform from a (4, 4) or (3, 4) matrix as files have it.

    A uniform scale of the axes is divided out, the position kept; rounding is removed by taking the nearest
    rotation.

    Raises:
        TronError: another shape, NaN, a mirrored, sheared or unevenly scaled matrix.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TronError("pose is not a matrix of numbers") from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise TronError(f"pose has shape {pose.shape}, not (4, 4)")
    if not np.isfinite(pose).all():
        raise TronError("pose holds NaN or infinity")
    if pose.shape == (4, 4) and not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise TronError("last row of the pose is not 0 0 0 1")
    u, scales, vt = np.linalg.svd(pose[:3, :3])
    if scales[0] < 1e-9 or scales[0] - scales[2] > 0.01 * scales[0]:
        raise TronError("pose is no rotation: its axes are not at right angles and of one length")
    if np.linalg.det(pose[:3, :3]) < 0:
        raise TronError("pose is mirrored: its axes are left-handed")
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid

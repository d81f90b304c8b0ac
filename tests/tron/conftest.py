"""Dense surfels of simple shapes, and the same shapes as Mitsuba knows them: one surface, described twice."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene, quats_from_normals

SPACING = 0.05


@pytest.fixture
def texture_error(variant: str) -> float:
    """Largest error of a lookup in Mitsuba's envmap, of its texels' range.

    On a GPU the plugin reads a hardware texture, whose bilinear weights have 8 bits of fraction, in two axes.
    """
    return 2 / 256 if variant.startswith("cuda") else 0.0


@dataclass(frozen=True)
class Sheet:
    """Points (N, 3) of a surface, their outward unit normals (N, 3), and the shape for ``mi.load_dict``."""

    points: np.ndarray
    normals: np.ndarray
    mitsuba: dict[str, Any]


class DenseSurfels:
    """Surfaces covered by surfels: kernel degree 4, scale 0.5 spacings, opacity 0.99."""

    def scene(self, *sheets: Sheet, spacing: float = SPACING, **fields: Any) -> GaussianScene:
        """Surfels on ``sheets``, grey and half rough unless ``fields`` says otherwise."""
        points = np.concatenate([sheet.points for sheet in sheets])
        normals = np.concatenate([sheet.normals for sheet in sheets])
        n = len(points)
        values = {
            "means": points,
            "quats": quats_from_normals(normals),
            "log_scales": np.full((n, 2), np.log(0.5 * spacing)),
            "opacity_logits": np.full(n, np.log(0.99 / 0.01)),
            "sh": np.zeros((n, 16, 3)),
            "base_color": np.full((n, 3), 0.5),
            "roughness": np.full(n, 0.5),
            "metallic": np.zeros(n),
            "object_id": np.zeros(n),
        }
        return GaussianScene(**{**values, **fields}, kernel_degree=4, spacing=spacing).validate()

    def plane(self, spacing: float = SPACING, half: float = 2.0) -> Sheet:
        """The square |x|, |y| < ``half`` at z = 0, facing +z."""
        points = _grid(spacing, half)
        # A cube: where Mitsuba 3.9.1 merges rectangles they leave scene.bbox(), and shadow rays end early.
        slab = _transform().translate([0, 0, -0.001]).scale([half, half, 0.001])
        shape = {"type": "cube", "to_world": slab}
        return Sheet(points, np.tile([0.0, 0, 1], (len(points), 1)), shape)

    def sphere(self, spacing: float = SPACING, radius: float = 1.0, height: float = 0.0) -> Sheet:
        """A sphere about (0, 0, ``height``): a Fibonacci lattice."""
        n = int(4 * np.pi * radius**2 / spacing**2)
        i = np.arange(n) + 0.5
        z, phi = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
        r = np.sqrt(1 - z * z)
        normals = np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
        shape = {"type": "sphere", "center": [0.0, 0.0, height], "radius": radius}
        return Sheet(normals * radius + [0, 0, height], normals, shape)

    def box(self, spacing: float = SPACING, half: float = 0.7, height: float = 0.0) -> Sheet:
        """A cube of side 2 ``half`` about (0, 0, ``height``)."""
        face = _grid(spacing, half) + np.array([0, 0, half])
        up = np.array([[0.0, 0, 1]])
        turns = [np.roll(np.eye(3), k, axis=0) for k in range(3)]
        turns += [-turn for turn in turns]
        points = np.concatenate([face @ turn.T for turn in turns])
        normals = np.concatenate([np.repeat(up @ turn.T, len(face), axis=0) for turn in turns])
        shape = {"type": "cube", "to_world": _transform().translate([0, 0, height]).scale(half)}
        return Sheet(points + np.array([0, 0, height]), normals, shape)

    def turned(self, sheet: Sheet, rotation: np.ndarray) -> Sheet:
        """``sheet`` turned about the origin by a (3, 3) rotation."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        before = sheet.mitsuba.get("to_world", _transform())
        shape = {**sheet.mitsuba, "to_world": type(before)(matrix.tolist()) @ before}
        return Sheet(sheet.points @ rotation.T, sheet.normals @ rotation.T, shape)


def _grid(spacing: float, half: float) -> np.ndarray:
    count = round(2 * half / spacing)
    along = (np.arange(count) + 0.5) / count * 2 * half - half
    x, y = np.meshgrid(along, along)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def _transform() -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f()


@pytest.fixture(scope="session")
def dense_surfels(variant: str) -> DenseSurfels:
    return DenseSurfels()


@pytest.fixture
def kernels_of(variant: str) -> Callable[[Callable[[], object]], set[str]]:
    """Texts of the kernels that some work launches.

    Left out are their names and the alignment of what they read, which is the allocator's chance. Dr.Jit's
    own ``cache_hit`` is true as well for a kernel that an earlier run left on disk, and so false where a
    machine is new.
    """
    import drjit as dr

    def texts(work: Callable[[], object]) -> set[str]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            work()
            kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        return {re.sub(r"drjit_[0-9a-f]+|align \d+", "", kernel["ir"].getvalue()) for kernel in kernels}

    return texts


def cameras_around(count: int, distance: float = 4.0, size: int = 32) -> list[Camera]:
    """Cameras on three rings that look at the origin."""
    cameras = []
    for i in range(count):
        turn, height = 2 * np.pi * i / count, (2.0, 0.3, -2.0)[i % 3]
        eye = np.array([3 * np.cos(turn), 3 * np.sin(turn), height])
        eye *= distance / np.linalg.norm(eye)
        cameras.append(Camera.look_at(eye, (0, 0, 0), fov_deg=32, width=size, height=size))
    return cameras


@pytest.fixture(scope="session")
def around() -> Callable[..., list[Camera]]:
    """Makes cameras on three rings that look at the origin."""
    return cameras_around


@pytest.fixture
def material(variant: str) -> Callable[[Any, Any, Any], SimpleNamespace]:
    """Make a grey material from base color, roughness and metallic, a number each or (N,)."""

    import mitsuba as mi

    def make(base_color: float, roughness: float, metallic: float) -> SimpleNamespace:
        base, rough, metal = (mi.Float(np.float32(value)) for value in (base_color, roughness, metallic))
        return SimpleNamespace(base_color=mi.Color3f(base), roughness=rough, metallic=metal)

    return make

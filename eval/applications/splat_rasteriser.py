"""3DGS viewer in float64 NumPy, independent of TRON's reader, harmonics and tracer.

Splatting by Zwicker et al. 2001 (EWA) with the choices of Kerbl et al. 2023 and of its reference code:
projected covariances J W S W' J' with 0.3 pixels added, at most 0.99 and at least 1/255 of opacity, up to the
edges of the tiles of 16 pixels that three deviations touch, sorted by the depth of centres, from 0.2 on,
colours max(0, harmonics + 0.5) towards each centre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
from scipy.special import expit

from tron.cameras import Camera

TILE = 16
NEAREST = 0.2


def rasterise(
    path: Path, camera: Camera, variance: float = 0.3, compensated: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Render display values (H, W, 3) over black, and opacity (H, W).

    Args:
        path: PLY of 3DGS, with harmonics of degree 0 to 3.
        camera: the view.
        variance: added to projected covariances, square pixels.
        compensated: lower the opacity to compensate for ``variance``, as 3DGS's ``--antialiasing`` does.
    """
    vertex = plyfile.PlyData.read(str(path))["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=-1)

    centres, turn = columns("x", "y", "z"), camera.world_to_camera[:3, :3]
    seen = centres @ turn.T + camera.world_to_camera[:3, 3]
    x, y, z = np.where(seen[:, 2:] > NEAREST, seen, [0, 0, 1]).T
    axes = _rotations(columns("rot_0", "rot_1", "rot_2", "rot_3")) * np.exp(
        columns("scale_0", "scale_1", "scale_2")[:, None]
    )
    limit_x, limit_y = 0.65 * camera.width / camera.fx, 0.65 * camera.height / camera.fy
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx / z, camera.fy / z
    jacobian[:, 0, 2] = -camera.fx * np.clip(x / z, -limit_x, limit_x) / z
    jacobian[:, 1, 2] = -camera.fy * np.clip(y / z, -limit_y, limit_y) / z
    flat = jacobian @ turn @ axes
    sharp = flat @ flat.transpose(0, 2, 1)
    covariance = sharp + variance * np.eye(2)
    inverse = np.linalg.inv(covariance)
    reach = np.ceil(3 * np.sqrt(np.linalg.eigvalsh(covariance)[:, 1]))
    u, v = camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5
    toward = centres - camera.position
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, :, None]
    numbers = sum(name.startswith("f_rest_") for name in vertex.data.dtype.names)
    if numbers:
        rest = columns(*(f"f_rest_{i}" for i in range(numbers))).reshape(len(z), 3, -1)
        sh = np.concatenate([sh, rest], axis=2)
    colors = np.maximum(np.einsum("mck,mk->mc", sh, _basis(*toward.T)[:, : sh.shape[2]]) + 0.5, 0)
    opacity = expit(columns("opacity")[:, 0])
    if compensated:
        opacity *= np.sqrt(np.maximum(np.linalg.det(sharp) / np.linalg.det(covariance), 2.5e-5))

    image, through = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    left, right = _tiles(u, reach, camera.width)
    top, bottom = _tiles(v, reach, camera.height)
    shown = (seen[:, 2] > NEAREST) & (left < right) & (top < bottom)
    order = np.flatnonzero(shown)[np.argsort(z[shown])]
    for i in order:
        x0, x1, y0, y1 = (int(edge[i]) for edge in (left, right, top, bottom))
        window = slice(y0, y1), slice(x0, x1)
        dx, dy = np.arange(x0, x1) - u[i], (np.arange(y0, y1) - v[i])[:, None]
        (a, b), (_, c) = inverse[i]
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), 0.99)
        alpha *= (alpha >= 1 / 255) & (through[window] > 1e-4)
        image[window] += (through[window] * alpha)[..., None] * colors[i]
        through[window] *= 1 - alpha
    return image, 1 - through


def _tiles(middle: np.ndarray, reach: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first pixels, and the pixels after the last, of the tiles within reach."""
    first, last = np.floor((middle - reach) / TILE), np.floor((middle + reach + TILE - 1) / TILE)
    return np.clip(TILE * first, 0, size).astype(int), np.clip(TILE * last, 0, size).astype(int)


def _rotations(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _basis(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the harmonics (M, 16), as in utils/sh_utils.py of the reference code."""
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    functions = [
        0.28209479177387814 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * xy,
        -1.0925484305920792 * yz,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * xz,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * xy * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(functions, axis=-1)

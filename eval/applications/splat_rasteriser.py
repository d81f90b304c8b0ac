"""What a 3DGS viewer draws of a PLY, in float64 NumPy and apart from tron's reader, harmonics and tracer.

Splatting by Zwicker et al. 2001 (EWA) with the choices of Kerbl et al. 2023 and of its reference code:
projected covariances J W S W' J' with 0.3 pixels added, at most 0.99 and at least 1/255 of opacity, sorted by
the depth of centres, colours max(0, harmonics + 0.5) towards each centre.
"""

from pathlib import Path

import numpy as np
import plyfile

from tron.cameras import Camera


def rasterise(path: Path, camera: Camera) -> np.ndarray:
    """(H, W, 3) display values over black."""
    vertex = plyfile.PlyData.read(str(path))["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=-1)

    centres, turn = columns("x", "y", "z"), camera.world_to_camera[:3, :3]
    seen = centres @ turn.T + camera.world_to_camera[:3, 3]
    x, y, z = np.where(seen[:, 2:] > 1e-2, seen, [0, 0, 1]).T
    axes = _rotations(columns("rot_0", "rot_1", "rot_2", "rot_3")) * np.exp(
        columns("scale_0", "scale_1", "scale_2")[:, None]
    )
    limit_x, limit_y = 0.65 * camera.width / camera.fx, 0.65 * camera.height / camera.fy
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx / z, camera.fy / z
    jacobian[:, 0, 2] = -camera.fx * np.clip(x / z, -limit_x, limit_x) / z
    jacobian[:, 1, 2] = -camera.fy * np.clip(y / z, -limit_y, limit_y) / z
    flat = jacobian @ turn @ axes
    covariance = flat @ flat.transpose(0, 2, 1) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(covariance)
    reach = np.ceil(3 * np.sqrt(np.linalg.eigvalsh(covariance)[:, 1]))
    u, v = camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5
    toward = centres - camera.position
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15)
    sh = np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, :, None], rest], axis=2)
    colors = np.maximum(np.einsum("mck,mk->mc", sh, _basis(*toward.T)) + 0.5, 0)
    opacity = 1 / (1 + np.exp(-columns("opacity")[:, 0]))

    image, through = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    left, right = (np.clip(u + k * reach + (k > 0), 0, camera.width).astype(int) for k in (-1, 1))
    top, bottom = (np.clip(v + k * reach + (k > 0), 0, camera.height).astype(int) for k in (-1, 1))
    shown = (seen[:, 2] > 1e-2) & (left < right) & (top < bottom)
    order = np.flatnonzero(shown)[np.argsort(z[shown])]
    for i in order:
        window = slice(top[i], bottom[i]), slice(left[i], right[i])
        dx, dy = np.arange(left[i], right[i]) - u[i], (np.arange(top[i], bottom[i]) - v[i])[:, None]
        (a, b), (_, c) = inverse[i]
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), 0.99)
        alpha *= (alpha >= 1 / 255) & (through[window] > 1e-4)
        image[window] += (through[window] * alpha)[..., None] * colors[i]
        through[window] *= 1 - alpha
    return image


def _rotations(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _basis(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(M, 16) as utils/sh_utils.py of the reference code writes them."""
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

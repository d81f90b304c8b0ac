"""The Gaussian scene: oriented flat Gaussians (surfels) with radiance and materials.

A surfel is the flat Gaussian of 2D Gaussian Splatting (Huang et al. 2024): a centre, an orientation whose
third axis is the normal, two standard deviations in the plane, an opacity, and what it looks like. A scan's
splats have a third deviation, which their own projections show and nothing else knows of. Everything is NumPy
at rest, in the world frame; trainable copies and device arrays are made by those who need them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from tron.errors import TronError, located
from tron.framing import upright
from tron.gaussians.fields import FIELDS, LOG_SCALE_LIMIT, MATERIALS
from tron.gaussians.harmonics import rotate_sh
from tron.gaussians.ply import write_ply
from tron.gaussians.projections import DISKS, PROJECTIONS
from tron.gaussians.reading import read_splats

log = logging.getLogger(__name__)

KERNEL_DEGREES = (2, 4)
# Densities are measured on at most this many surfels: the median does not move, a million queries take
# seconds.
SPACING_QUERIES = 50_000
# Fewer centres have no plane through them.
FEWEST_NEIGHBOURS = 4
# Share of round Gaussians from which they are a scan's kind: 3 to 4 % are in those of 3DGS, all in SplaTAM's.
ROUND_SHARE = 0.2

_TOLERANCE = 1e-3


@dataclass(eq=False)
class GaussianScene:
    """M surfels in the world frame (right-handed; z up in the scenes we make).

    Arrays are float32 (object_id int32); other dtypes are converted on construction.

    Attributes:
        means: (M, 3) centres, world units.
        quats: (M, 4) unit quaternions (w, x, y, z); the columns of R are tangent u, tangent v, normal.
        log_scales: (M, 2) natural logarithm of the standard deviations along u and v, world units.
        opacity_logits: (M,) opacity = 1 / (1 + exp(-logit)).
        sh: (M, 16, 3) degree-3 harmonics of the radiance in *display* space: colour = max(0, SH + 0.5).
        base_color: (M, 3) linear, in [0, 1].
        roughness: (M,) in [0, 1]; GGX alpha is its square.
        metallic: (M,) in [0, 1].
        object_id: (M,) which object a surfel belongs to; 0 where nothing is known.
        kernel_degree: 2 for exp(-d^2 / 2), as in 2DGS; 4 for exp(-4.5/81 d^4), flatter and sharper.
        spacing: distance between neighbouring surfels, world units (see :func:`measure_spacing`).
        up: (3,) unit up direction.
        up_guessed: True where nobody has said which way is up.
        materials_guessed: True where the materials were derived from colours, not measured.
        oriented: False where the sign of the normals means nothing, as in files of 3DGS: camera rays skip
            back faces, so such scenes are turned towards each camera first (:meth:`facing`).
        offset: (3,) float64 what was taken away from large coordinates, such as those of UTM: the file's are
            means + offset (:mod:`tron.io.local_frame`). Zero in most scenes.
        projection: how cameras see the surfels (:data:`tron.gaussians.projections.PROJECTIONS`): as disks in
            space, or as the program that a scan's splats were learnt with projects them.
        log_thickness: (M,) natural logarithm of the standard deviation along the normal, world units, the
            least of three; -infinity, as of all by default, of flat surfels. Only ``projection`` shows it.
        emission: (M, 3) radiance that the front of a surfel emits, the same in all directions, linear
            (Rec.709), not below 0; 0, as of all by default, where nothing glows.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    object_id: np.ndarray
    kernel_degree: int = 2
    spacing: float = 0.0
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    up_guessed: bool = False
    materials_guessed: bool = False
    oriented: bool = True
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    projection: str = DISKS
    log_thickness: np.ndarray = field(default_factory=lambda: np.empty(0))
    emission: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        # Flat and dark scenes may be made of others of more or fewer surfels without a word of it.
        if len(self.log_thickness) != len(self.means) and np.isneginf(self.log_thickness).all():
            self.log_thickness = np.full(len(self.means), -np.inf)
        if len(self.emission) != len(self.means) and not np.any(self.emission):
            self.emission = np.zeros((len(self.means), 3), np.float32)
        for name, described in FIELDS.items():
            setattr(self, name, np.ascontiguousarray(getattr(self, name), dtype=described.dtype))
        self.up = np.asarray(self.up, dtype=np.float64)
        self.offset = np.asarray(self.offset, dtype=np.float64)
        self.kernel_degree = int(self.kernel_degree)
        self.spacing = float(self.spacing)

    def __len__(self) -> int:
        return len(self.means)

    def rotations(self) -> np.ndarray:
        """(M, 3, 3) float32 rotation matrices, local to world; columns are tangent u, tangent v, normal."""
        return rotation_matrices(self.quats)

    def normals(self) -> np.ndarray:
        """(M, 3) float32 unit normals, world: the third column of the rotation."""
        return np.ascontiguousarray(self.rotations()[:, :, 2])

    def tangents(self) -> tuple[np.ndarray, np.ndarray]:
        """Two (M, 3) float32 arrays of unit tangents u and v, world; u x v is the normal."""
        rotations = self.rotations()
        return np.ascontiguousarray(rotations[:, :, 0]), np.ascontiguousarray(rotations[:, :, 1])

    def scales(self) -> np.ndarray:
        """(M, 2) float32 standard deviations along u and v, world units."""
        return np.exp(self.log_scales)

    def opacities(self) -> np.ndarray:
        """(M,) float32 opacities in (0, 1)."""
        return expit(self.opacity_logits)

    def bounds(self, trim: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner, two (3,) float64 arrays, of the axis-aligned box around the centres.

        `trim` in [0, 0.5) is the fraction of surfels left out at each end of each axis: captures have stray
        surfels far away, and a frame that holds them all shows nothing.
        """
        low, high = np.quantile(self.means.astype(np.float64), [trim, 1.0 - trim], axis=0)
        return low, high

    def facing(self, point: np.ndarray) -> GaussianScene:
        """Return the scene with all normals turned to the side of a point (3,), world."""
        return self.turned_over(self.looks_away(point))

    def looks_away(self, point: np.ndarray) -> np.ndarray:
        """(M,) bool: surfels whose normal is not on the side of a point (3,), world."""
        return np.einsum("mi,mi->m", self.normals(), self.means - np.asarray(point, np.float32)) > 0

    def turned_over(self, which: np.ndarray) -> GaussianScene:
        """The scene with some surfels, (M,) bool, turned half about their tangent u: same disk, other side.

        Arrays that do not change are shared with this scene.
        """
        w, x, y, z = self.quats.T
        turned = np.stack([-x, w, z, -y], axis=-1)
        return replace(self, quats=np.where(which[:, None], turned, self.quats))

    def rotated(self, rotation: np.ndarray) -> GaussianScene:
        """Rotate the scene about the origin by a (3, 3) rotation: centres, frames, radiance and up.

        A mirror image, of determinant -1, is one too: tangents u are turned over, so that frames stay
        right-handed and normals are mirrored.
        """
        rotation = np.asarray(rotation, dtype=np.float64)
        handed = np.array([np.sign(np.linalg.det(rotation)), 1, 1])
        return replace(
            self,
            means=self.means @ rotation.T,
            quats=quats_from_matrices(rotation @ self.rotations() * handed),
            sh=rotate_sh(self.sh, rotation),
            up=rotation @ self.up,
            offset=rotation @ self.offset,
        )

    def upright(self) -> GaussianScene:
        """Rotate the scene the shortest way about the origin so that ``up`` is +z, as in environment maps."""
        turn = upright(self.up)
        return self if np.allclose(turn, np.eye(3)) else self.rotated(turn)

    def validate(self, where: str | Path | None = None) -> GaussianScene:
        """Return the scene itself if it is valid; raise TronError naming the first invalid field.

        `where`, the file the scene comes from, is added to the message.
        """
        with located(where):
            self._check()
        return self

    def _check(self) -> None:
        count = len(self.means)
        if count == 0:
            raise TronError("the scene has no surfels")
        for name, described in FIELDS.items():
            values, expected = getattr(self, name), (count, *described.shape)
            if values.shape != expected:
                raise TronError(f"{name} has shape {values.shape}, expected {expected}")
            good = np.isfinite(values) | (np.isneginf(values) & described.zero)
            if not good.all():
                bad = ~good.reshape(count, -1).all(axis=1)
                raise TronError(
                    f"{name} of {bad.sum()} of {count} surfels is not finite (first: {bad.argmax()})"
                )
        for name in MATERIALS:
            values = getattr(self, name).reshape(count, -1)
            if values.min() < -_TOLERANCE or values.max() > 1 + _TOLERANCE:
                bad = ((values < -_TOLERANCE) | (values > 1 + _TOLERANCE)).any(axis=1)
                raise TronError(f"{name} of {bad.sum()} surfels is outside [0, 1] (first: {bad.argmax()})")
        bad = (self.emission < 0).any(axis=1)
        if bad.any():
            raise TronError(f"emission of {bad.sum()} surfels is below 0 (first: surfel {bad.argmax()})")
        bad = (np.abs(self.log_scales) > LOG_SCALE_LIMIT).any(axis=1)
        if bad.any():
            raise TronError(f"log_scales of {bad.sum()} surfels are absurd (first: surfel {bad.argmax()})")
        bad = self.log_thickness > self.log_scales.min(axis=1)
        if bad.any():
            what = f"{bad.sum()} surfels are thicker than wide (first: surfel {bad.argmax()})"
            raise TronError(what, mend="change log_thickness with log_scales")
        lengths = np.linalg.norm(self.quats, axis=1)
        bad = np.abs(lengths - 1) > _TOLERANCE
        if bad.any():
            raise TronError(
                f"quaternion of {bad.sum()} surfels is not a unit one (first: surfel {bad.argmax()}, "
                f"length {lengths[bad.argmax()]:.3g})"
            )
        if self.kernel_degree not in KERNEL_DEGREES:
            raise TronError(f"kernel_degree is {self.kernel_degree}", mend="use 2 or 4")
        if self.projection not in PROJECTIONS:
            raise TronError(f"projection is {self.projection}", mend=f"use one of {', '.join(PROJECTIONS)}")
        if not (np.isfinite(self.spacing) and self.spacing > 0):
            raise TronError(
                f"spacing is {self.spacing}", mend="give a positive length, or measure_spacing(means)"
            )
        if self.up.shape != (3,) or not abs(np.linalg.norm(self.up) - 1) < _TOLERANCE:
            raise TronError(f"up is {self.up.tolist()}", mend="give a unit vector of three numbers")
        if self.offset.shape != (3,) or not np.isfinite(self.offset).all():
            raise TronError(f"offset is {self.offset.tolist()}", mend="give three finite numbers")

    def save(self, path: str | Path, on_map: bool = False) -> None:
        """Write a PLY that 3DGS readers open too (:mod:`tron.gaussians.ply`), atomically.

        Args:
            path: the file.
            on_map: put ``offset`` back, in float64, for programs that know nothing of our comment.

        Raises:
            TronError: the scene is not whole, or the file cannot be written.
        """
        content = vars(self.validate()) | {"normals": self.normals()}
        if on_map and self.offset.any():
            content |= {"means": self.means + self.offset, "offset": np.zeros(3)}
        write_ply(path, content)

    @classmethod
    def load(cls, path: str | Path) -> GaussianScene:
        """Read a TRON, 2DGS or 3DGS PLY, or another file of splats (docs/guides/formats.md).

        What files leave out: :func:`tron.gaussians.reading.read_splats`.

        A file that says no spacing has it measured. Where a scan is made of round Gaussians, as those of
        SplaTAM and MonoGS, which have no axis for a normal, they get that of their neighbourhood.

        Raises:
            TronError: no such file, or no scene in it.
        """
        values = read_splats(path)
        means, round_ones = values["means"], values.pop("round_ones")
        if round_ones.mean() > ROUND_SHARE and len(means) >= FEWEST_NEIGHBOURS:
            log.warning(
                "%s: %d of %d splats are as thick as wide, without a normal: it is taken from the places of "
                "their neighbours", path, round_ones.sum(), len(means),
            )  # fmt: skip
            values["quats"][round_ones] = quats_from_normals(neighbour_normals(means, round_ones))
        if "spacing" not in values:
            values["spacing"] = measure_spacing(means)
        turn = values.pop("turn")
        scene = cls(**values)
        return (scene if np.array_equal(turn, np.eye(3)) else scene.rotated(turn)).validate(path)


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """(M, 4) quaternions (w, x, y, z) of any non-zero length -> (M, 3, 3) float32 rotation matrices."""
    xyzw = np.asarray(quats, dtype=np.float64)[:, [1, 2, 3, 0]]
    return Rotation.from_quat(xyzw).as_matrix().astype(np.float32)


def quats_from_matrices(rotations: np.ndarray) -> np.ndarray:
    """(M, 3, 3) rotation matrices -> (M, 4) float32 unit quaternions (w, x, y, z) with w >= 0."""
    xyzw = Rotation.from_matrix(np.asarray(rotations, dtype=np.float64)).as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def quats_from_normals(normals: np.ndarray) -> np.ndarray:
    """(M, 3) unit normals -> (M, 4) float32 unit quaternions (w, x, y, z) with any tangents.

    The tangents are the branchless basis of Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
    x, y, z = np.asarray(normals, dtype=np.float64).T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    v = np.stack([b, sign + y * y * a, -y], axis=-1)
    return quats_from_matrices(np.stack([u, v, np.stack([x, y, z], axis=-1)], axis=-1))


def neighbour_distances(
    means: np.ndarray, queries: np.ndarray | None = None, neighbours: int = 3
) -> np.ndarray:
    """Root mean square distance of each centre to its nearest others, as 3DGS initialises its scales.

    means (M, 3), world; queries (Q,) indices into means, all of them by default. Returns (Q,) float64, world
    units. With fewer centres than neighbours + 1, those that exist are used; a single centre gives 0.
    """
    points = np.asarray(means, dtype=np.float64)
    asked = points if queries is None else points[queries]
    count = min(neighbours + 1, len(points))
    if count == 1:
        return np.zeros(len(asked))
    distances = KDTree(points).query(asked, k=count)[0]
    return np.sqrt((distances[:, 1:] ** 2).mean(axis=1))


def measure_spacing(means: np.ndarray) -> float:
    """The scene's surfel spacing nn: median of neighbour_distances, world units, never zero.

    Shadow rays start and count back faces in units of it (conventions.md, 8). Large scenes are measured
    on an evenly strided part of their surfels, against all of them.
    """
    stride = -(-len(means) // SPACING_QUERIES)
    distances = neighbour_distances(means, np.arange(0, len(means), max(stride, 1)))
    apart = distances[distances > 0]
    if len(apart):
        return float(np.median(apart))
    extent = float(np.ptp(means, axis=0).max()) if len(means) else 0.0
    return extent or 1.0


NEIGHBOURS = 16
_CHUNK = 100_000


def neighbour_normals(means: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Unit normals (K, 3) float64, of either sign, of the chosen points: axes of least spread.

    The eigenvector of the least eigenvalue of the covariance of the sixteen nearest points, the point itself
    included (Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points", section 3.2).

    Args:
        means: (M, 3) all points, three or more, world.
        which: (M,) bool, K of them true.
    """
    points = np.asarray(means, np.float64)
    tree, asked = KDTree(points), np.flatnonzero(which)
    normals = np.empty((len(asked), 3))
    for start in range(0, len(asked), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        near = tree.query(points[asked[chunk]], k=min(NEIGHBOURS, len(points)), workers=-1)[1]
        around = points[near] - points[near].mean(axis=1, keepdims=True)
        normals[chunk] = np.linalg.eigh(around.transpose(0, 2, 1) @ around)[1][:, :, 0]
    return normals

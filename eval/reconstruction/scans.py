"""Scans in the form of other programs: plain 3DGS files of known scenes, and errors of their surfaces.

A 3DGS file has positions, radiance, opacity, three scales and a rotation. It does not say which axis is the
normal, which side is the front, or what the material is. Axes are permuted and flipped at random, so that the
order of our arrays does not reveal it either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile

from eval.reconstruction.pictures import normal_picture
from eval.reconstruction.relighting import Relit, relight
from eval.results import Row, mean_row
from tron.captures.folder import read_capture_folder
from tron.gaussians.fields import FIELDS
from tron.gaussians.ply import NORMAL, REST
from tron.gaussians.scene import GaussianScene, quats_from_matrices
from tron.metrics import angular_errors_deg
from tron.relighting import Relighter
from tron.report.page import Picture, Pictures
from tron.seeds import generator
from tron.storage import atomic_path

THICKNESS = 0.3
"""Third scale of a Gaussian of the scans, over the smaller of the others: thin, and no more than that."""


@dataclass(frozen=True)
class Scan:
    """Errors of a scan's surfaces against its true scene.

    Attributes:
        name: name of the scene.
        normals: errors of normals in the held-out views, degrees: ``normal_mae_deg`` and
            ``normal_median_deg``, means over the views.
        surfels: their number.
        seconds: wall time of the command that made it.
        relit: scores under other lights.
        views: normals of the middle held-out view: (truth, found), (H, W, 3) display values.
    """

    name: str
    normals: dict[str, float]
    surfels: int
    seconds: float
    relit: Relit
    views: tuple[np.ndarray, np.ndarray]


def write_scan(path: Path, scene: GaussianScene, seed: int) -> None:
    """Write a scene as a plain 3DGS PLY without materials, comments or recoverable normals.

    The kernel of such files is of degree 2, so the scene's must be.
    """
    rng, count = generator(seed, "reconstruction", "scan"), len(scene)
    scales = np.concatenate([scene.scales(), THICKNESS * scene.scales().min(1, keepdims=True)], axis=1)
    first, over = rng.integers(0, 3, count), rng.random(count) < 0.5
    order = (first[:, None] + np.arange(3)) % 3  # cyclic: the frame stays right-handed
    rotations = scene.rotations()
    rotations[over, :, 1:] *= -1  # half a turn about the first tangent
    rotations = np.take_along_axis(rotations, order[:, None, :], axis=2)
    columns = dict(zip(FIELDS["means"].properties, scene.means.T))
    columns |= dict(zip(NORMAL, np.zeros((3, count))))
    columns |= dict(zip(FIELDS["sh"].properties, scene.sh[:, 0].T))
    columns |= dict(zip(REST, scene.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1).T))
    columns |= {FIELDS["opacity_logits"].properties[0]: scene.opacity_logits}
    columns |= {f"scale_{axis}": np.log(np.take_along_axis(scales, order, 1)[:, axis]) for axis in range(3)}
    columns |= dict(zip(FIELDS["quats"].properties, quats_from_matrices(rotations).T))
    rows = np.empty(count, dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


def collect_scan(name: str, scene: Path, capture: Path, truths: Sequence[Path], seconds: float) -> Scan:
    """Score the surfaces of a scan.

    Args:
        name: name of the path-traced scene.
        scene: the surfels, in the world of the capture.
        capture: path-traced views with true normals.
        truths: the views under other lights, see :func:`relight`.
        seconds: time to make the scan.
    """
    surfels, views = GaussianScene.load(scene), read_capture_folder(capture).test_views
    relighter = Relighter(surfels)
    means, medians, pictures = [], [], []
    for view in views:
        normal, truth = (
            relighter.tracer(view.camera).gbuffer(view.camera).numpy()["normal"],
            view.read("normal"),
        )
        known = np.asarray(truth.any(axis=-1) & (view.read("mask") > 0.5))
        angles = angular_errors_deg(normal, truth, known)
        means.append(angles.mean())
        medians.append(np.median(angles))
        shown = (truth, known), (normal, np.asarray(normal.any(axis=-1)))
        pictures.append(tuple(normal_picture(*each) for each in shown))
    normals = {"normal_mae_deg": float(np.mean(means)), "normal_median_deg": float(np.mean(medians))}
    relit = relight(scene, truths)
    return Scan(name, normals, len(surfels), seconds, relit, pictures[len(pictures) // 2])


def scan_rows(way: str, scans: Sequence[Scan], seed: int = 0) -> Iterator[Row]:
    """Yield means over the scans: ``splats.*`` reconstructed, ``splats.raw.*`` for the files as they are."""
    prefix = "splats" if way == "splats" else f"splats.{way}"
    for figure in ("normal_mae_deg", "normal_median_deg"):
        yield mean_row(
            f"{prefix}.{figure}", "deg", [(scan.name, scan.normals[figure]) for scan in scans], seed
        )
    yield mean_row(f"{prefix}.relight_psnr", "dB", [(scan.name, scan.relit.psnr) for scan in scans], seed)
    yield Row(metric=f"{prefix}.surfels", value=max(s.surfels for s in scans), unit="surfels", n=len(scans))
    yield Row(metric=f"{prefix}.seconds", value=max(s.seconds for s in scans), unit="s", n=len(scans))


def normal_pictures(scans: Mapping[str, Scan]) -> Pictures:
    """Show the true normals of a scene, and the normals of its scans by title."""
    first = next(iter(scans.values()))
    pictures = [Picture(first.views[0], "true normals", f"true normals of scene {first.name}", strong=True)]
    for title, scan in scans.items():
        figure = f"{scan.normals['normal_mae_deg']:.1f}°"
        pictures.append(Picture(scan.views[1], title, f"normals of scene {scan.name}, {title}", figure))
    return Pictures(f"Normals of scene {first.name}", pictures, columns=len(pictures))

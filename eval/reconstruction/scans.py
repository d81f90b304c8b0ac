"""Scans as other programs leave them: plain 3DGS files of known scenes, and how good their surfaces are.

A file of 3DGS has positions, radiance, opacity, three scales and a rotation. Which of its axes is a normal,
on which side the surface lies and what it is made of nobody wrote down; so that nothing of that is handed
over by the order of our arrays, axes are exchanged and turned over at random.
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
    """Surfaces of one scan, against the truth of the scene that it is of.

    Attributes:
        name: of the scene.
        normals: figures of the held-out views' normals by name, degrees: ``normal_mae_deg`` and
            ``normal_median_deg``, means over the views.
        surfels: their number.
        seconds: wall time of the command that made it.
        relit: under other lights.
        views: normals of the middle held-out view: (truth, found), (H, W, 3) display values.
    """

    name: str
    normals: dict[str, float]
    surfels: int
    seconds: float
    relit: Relit
    views: tuple[np.ndarray, np.ndarray]


def write_scan(path: Path, scene: GaussianScene, seed: int) -> None:
    """Write a scene as a plain 3DGS PLY: no materials, no comments, normals nobody can read off.

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
        name: of the path-traced scene.
        scene: the surfels, in its world.
        capture: path-traced views of it with true normals.
        truths: the same under other lights, see :func:`relight`.
        seconds: that making it took.
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
    """Means over the scans: ``splats.*`` of those made anew, ``splats.raw.*`` of the files as they are."""
    prefix = "splats" if way == "splats" else f"splats.{way}"
    for figure in ("normal_mae_deg", "normal_median_deg"):
        yield mean_row(
            f"{prefix}.{figure}", "deg", [(scan.name, scan.normals[figure]) for scan in scans], seed
        )
    yield mean_row(f"{prefix}.relight_psnr", "dB", [(scan.name, scan.relit.psnr) for scan in scans], seed)
    yield Row(metric=f"{prefix}.surfels", value=max(s.surfels for s in scans), unit="surfels", n=len(scans))
    yield Row(metric=f"{prefix}.seconds", value=max(s.seconds for s in scans), unit="s", n=len(scans))


def normal_pictures(scans: Mapping[str, Scan]) -> Pictures:
    """True normals of a scene, and those of its scans by their titles."""
    first = next(iter(scans.values()))
    pictures = [Picture(first.views[0], "true normals", f"true normals of scene {first.name}", strong=True)]
    for title, scan in scans.items():
        figure = f"{scan.normals['normal_mae_deg']:.1f}°"
        pictures.append(Picture(scan.views[1], title, f"normals of scene {scan.name}, {title}", figure))
    return Pictures(f"Normals of scene {first.name}", pictures, columns=len(pictures))

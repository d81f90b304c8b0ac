"""Scans in their original colours: TRON's picture against splat viewers.

The reference is 3DGS's rasterisation in float64 (:mod:`eval.applications.splat_rasteriser`), of real scans
and of a world whose light is in harmonics of degree 1, 2 and 3. If PlayCanvas' engine is installed, both are
compared with its pictures too. Display values over black count where the rasteriser or TRON covers a pixel.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from eval.applications.splat_rasteriser import rasterise
from eval.exchange.playcanvas import NARROW, shown
from eval.exchange.splats import Baked, Drawn, alike
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.metrics import capped_psnr
from tron.relighting import Relighter
from tron.report.page import Picture, Pictures

log = logging.getLogger(__name__)

ELEVATIONS = (10.0, 30.0, -5.0, 50.0)
"""Degrees above the level plane, one view after the other."""
DEGREES = (1, 2, 3)
_SOLID = 0.5


@dataclass
class Viewed:
    """Figures: pairs of a scan's name and a view's dB.

    Attributes:
        own, disks: TRON against the rasteriser, by projected splats and by disks in space.
        engine, engine_rasteriser: TRON and the rasteriser against PlayCanvas' engine.
        engine_narrow: the rasteriser with the engine's filter against the engine.
        harmonics: as ``own``, of the drawn world with harmonics of each degree.
    """

    own: list[tuple[str, float]] = field(default_factory=list)
    disks: list[tuple[str, float]] = field(default_factory=list)
    engine: list[tuple[str, float]] = field(default_factory=list)
    engine_rasteriser: list[tuple[str, float]] = field(default_factory=list)
    engine_narrow: list[tuple[str, float]] = field(default_factory=list)
    harmonics: list[tuple[str, float]] = field(default_factory=list)

    def rows(self, seed: int) -> Iterator[Row]:
        """Yield rows ``viewer.*``; ``seed`` draws the intervals."""
        every = [*self.own, *self.harmonics]
        if self.own:
            yield mean_row("viewer.psnr", "dB", self.own, seed)
            yield mean_row("viewer.disks_psnr", "dB", self.disks, seed)
        worst = min(value for _, value in every)
        yield Row(metric="viewer.worst", value=worst, unit="dB", n=len(every))
        for name in dict.fromkeys(name for name, _ in every):
            values = [value for scan, value in every if scan == name]
            yield Row(metric=f"viewer.{name}.psnr", value=float(np.mean(values)), unit="dB", n=len(values))
        if self.engine:
            yield mean_row("viewer.playcanvas.psnr", "dB", self.engine, seed)
            yield mean_row("viewer.playcanvas.rasteriser_psnr", "dB", self.engine_rasteriser, seed)
            yield mean_row("viewer.playcanvas.narrow_psnr", "dB", self.engine_narrow, seed)
            pairs = zip(self.engine_rasteriser, self.engine, strict=True)
            behind = [(name, theirs - ours) for (name, theirs), (_, ours) in pairs]
            yield mean_row("viewer.playcanvas.behind", "dB", behind, seed)


def measure_viewer(
    scans: Sequence[Path],
    world: Baked,
    views: int,
    sides: Sequence[int],
    engine: Path | None,
    folder: Path,
    seed: int,
    outcome: Outcome,
) -> None:
    """Draw scans by TRON and by viewers, and compare.

    Args:
        scans: plain PLYs of 3DGS.
        world: written with harmonics up to each degree, and drawn from its own cameras.
        views: of each scan, around it. sides: pixels of the square pictures.
        engine: PlayCanvas' package, which draws the first and the last view at the first side; None: none.
        folder: for files in between.
        seed: root of the intervals.
        outcome: takes rows and pictures.
    """
    found, pictures = Viewed(), []
    for path in scans:
        scene = GaussianScene.load(path)
        name = path.name.split(".")[0].replace("-", "_").lower()
        for side in sides:
            cameras = _around(scene, views, side)
            for number, camera in enumerate(cameras):
                truth = Drawn(*_clipped(*rasterise(path, camera)))
                own = _own(scene, camera)
                found.own += [(name, value) for value in alike([own], [truth])]
                if side != sides[0]:
                    continue
                disks = _own(replace(scene, projection="disks"), camera)
                found.disks += [(name, value) for value in alike([disks], [truth])]
                if engine is not None and number in (0, views - 1):
                    (theirs,) = shown(engine, path, [camera])
                    solid = truth.opacity > _SOLID
                    found.engine.append((name, capped_psnr(own.image, theirs, solid)))
                    found.engine_rasteriser.append((name, capped_psnr(truth.image, theirs, solid)))
                    narrow, _ = _clipped(*rasterise(path, camera, NARROW))
                    found.engine_narrow.append((name, capped_psnr(narrow, theirs, solid)))
                if number == 0:
                    values = (f"{each[-1][1]:.1f} dB" for each in (found.own, found.disks))
                    pictures += [
                        Picture(truth.image, f"{name}, 3DGS", f"{name}, drawn by a rasteriser of 3DGS"),
                        Picture(own.image, "TRON", f"{name}, drawn by TRON", next(values), strong=True),
                        Picture(disks.image, "disks in space", f"{name}, drawn as disks", next(values)),
                    ]
            log.info("%s at %d: %.1f dB", name, side, np.mean([v for _, v in found.own[-views:]]))
    for degree in DEGREES:
        scene = replace(world.scene, sh=world.scene.sh * (np.arange(16) < (degree + 1) ** 2)[:, None])
        file = folder / f"degree-{degree}.ply"
        write_splats(file, scene)
        plain = replace(world.plain, sh=scene.sh)
        for camera in world.cameras:
            truth = Drawn(*_clipped(*rasterise(file, camera)))
            found.harmonics += [
                (f"harmonics_{degree}", value) for value in alike([_own(plain, camera)], [truth])
            ]
    outcome.add(found.rows(seed))
    if pictures:
        outcome.show("viewer", "viewer", Pictures("A scan under its own look", pictures, columns=3))


def _around(scene: GaussianScene, views: int, side: int) -> list[Camera]:
    return [
        Camera.around(
            scene, azimuth_deg=360 * k / views + 20, elevation_deg=ELEVATIONS[k % len(ELEVATIONS)],
            width=side, height=side,
        )
        for k in range(views)
    ]  # fmt: skip


def _own(scene: GaussianScene, camera: Camera) -> Drawn:
    """Render a scan in its own colours, as TRON's cameras do."""
    view = Relighter(scene, proxy="never").gbuffer(camera)
    images = view.images({"rgb": view.rgb, "opacity": view.opacity})
    return Drawn(*_clipped(images["rgb"], images["opacity"]))


def _clipped(image: np.ndarray, opacity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.clip(image, 0, 1), opacity

"""Splats in every format: we write them, another program reads them, one tracer draws both.

Scenes are surfels with baked light in their harmonics, so colours change with the view.
Files hold kernels of degree 2; ``format.degree2.psnr`` is the loss by this change, and every format is
compared with the degree-2 scene that went into it. Splat files do not say which side a surfel shows, so both
sides are drawn; ``format.both_sides.psnr`` is the loss. Files that splat-transform writes and we read have
the same reference. ``scene_psnr`` compares with the scene itself: all losses together. Only pixels that
surfels cover before or after count.
"""

from __future__ import annotations

import importlib.util
import logging
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import plyfile

from eval.applications.splat_rasteriser import rasterise
from eval.applications.worlds import draw_world, view_of
from eval.exchange import readers
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.tracing.scene import LIGHTS
from tron.cameras import Camera
from tron.errors import TronError
from tron.estimation import Estimation
from tron.framing import Y_UP, upright
from tron.gaussians.edit import with_kernel
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.metrics import capped_psnr
from tron.relighting import Relighter
from tron.relighting.baking import baked
from tron.report.page import Picture, Pictures
from tron.seeds import generator, integer
from tron.shading.guidance import averaged
from tron.tracing import SurfelTracer
from tron.trajectories import turn_cameras

log = logging.getLogger(__name__)

VIEWS, SIDE = 3, 256
"""Views of a world, pixels along a side."""
FINENESS = 2
"""Sub-pixels along a pixel's side."""
THINGS = 4
ROUNDS = 3
"""Repetitions of what is timed; the median counts."""
COVERED = 0.01
"""Opacity from which a pixel counts."""
MAGNIFIED = 10
"""Factor on differences that are shown."""

Convert = Callable[[Path, Path], None]
"""Makes a file, the second, of another."""


class Reader(NamedTuple):
    """Another program that reads splats.

    Attributes:
        name: for people.
        convert: converts a file into a plain 3DGS PLY; None if the program is missing.
        why: reason why it is missing.
    """

    name: str
    convert: Convert | None
    why: str = ""


class Exchanged(NamedTuple):
    """A format of splat files.

    Attributes:
        name: name in rows.
        suffix: suffix of its files.
        reader: key of :func:`find_readers`; that program reads our files, or writes files for us.
        stands: whether files are y up, such as glTF and USD.
        ours: whether we write it.
    """

    name: str
    suffix: str
    reader: str
    stands: bool = False
    ours: bool = True


FORMATS = (
    Exchanged("ply", ".ply", "splat_transform"),
    Exchanged("spz", ".spz", "splat_transform"),
    Exchanged("sog", ".sog", "splat_transform"),
    Exchanged("splat", ".splat", "splat_transform"),
    Exchanged("glb", ".glb", "trimesh", stands=True),
    *(Exchanged(f"usd{k}", f".usd{k}", "usd_core", stands=True) for k in ("", "a", "c", "z")),
    Exchanged("compressed_ply", ".compressed.ply", "splat_transform", ours=False),
    Exchanged("their_spz", ".spz", "splat_transform", ours=False),
    Exchanged("their_sog", ".sog", "splat_transform", ours=False),
)


def find_readers(splat_transform: Path | None) -> dict[str, Reader]:
    """Return name -> program; ``splat_transform`` is its path, None if it is missing."""
    usd = Reader("usd-core", readers.usd_core)
    if importlib.util.find_spec("pxr") is None:
        usd = Reader("usd-core", None, "usd-core is not installed: pip install 'tron-relight[usd]'")
    playcanvas = Reader("splat-transform", None, f"splat-transform is not there: {readers.INSTALL}")
    if splat_transform is not None:
        playcanvas = Reader("splat-transform", partial(readers.splat_transform, splat_transform))
    return {
        "splat_transform": playcanvas,
        "usd_core": usd,
        "trimesh": Reader("trimesh", readers.trimesh_gltf),
    }


@dataclass(frozen=True, eq=False)
class Baked:
    """A world with its light baked into harmonics.

    Attributes:
        name: of the world.
        scene: surfels with kernels of degree 4, z up.
        plain: the surfels with kernels of degree 2 and without signs of normals, as in files.
        cameras: that look at it.
    """

    name: str
    scene: GaussianScene
    plain: GaussianScene
    cameras: list[Camera]

    @classmethod
    def drawn(cls, number: int, surfels: int, seed: int) -> Baked:
        """Draw world ``number`` of a seed, with about so many surfels, under one light of :data:`LIGHTS`."""
        kind = list(LIGHTS)[number % len(LIGHTS)]
        world = draw_world(seed, "exchange", number, kind, THINGS)
        relighter = Relighter(
            world.surfels(surfels), Estimation(), integer(seed, "exchange", number), proxy="never"
        )
        scene = baked(relighter.under(world.light), world.light.exposure(), "none")
        rng = generator(seed, "exchange", number, "views")
        cameras = [view_of(rng, SIDE, SIDE) for _ in range(VIEWS)]
        return cls(
            f"world_{number}",
            scene,
            replace(with_kernel(scene, 2), oriented=False, projection="3dgs"),
            cameras,
        )

    def standing(self) -> Baked:
        """Return the world in the frame of y-up files, which sort splats of equal depth in another order."""
        turn = Y_UP @ upright(self.scene.up)
        scene, plain = self.scene.rotated(turn), self.plain.rotated(turn)
        return Baked(self.name, scene, plain, turn_cameras(self.cameras, turn))


class Drawn(NamedTuple):
    """A view: display values (H, W, 3) over black, and opacity (H, W)."""

    image: np.ndarray
    opacity: np.ndarray


def draw(scene: GaussianScene, cameras: Sequence[Camera]) -> list[Drawn]:
    """Render a scene's harmonics by TRON's tracer, as means over sub-pixels.

    If signs of normals have no meaning, all surfels are turned to each camera, as commands do.
    """
    tracer, found = SurfelTracer(scene), []
    for camera in cameras:
        seen = tracer if scene.oriented else tracer.turned_over(scene.looks_away(camera.position))
        view = seen.gbuffer(_fine(camera))
        images = view.images({"rgb": view.rgb, "opacity": view.opacity})
        shown = np.clip(images["rgb"], 0, 1)  # as viewers do
        found.append(Drawn(averaged(shown, FINENESS), averaged(images["opacity"], FINENESS)))
    return found


def alike(found: Sequence[Drawn], wanted: Sequence[Drawn]) -> list[float]:
    """Return the capped PSNR in dB of each view, over pixels that either one covers."""
    return [
        capped_psnr(a.image, b.image, np.maximum(a.opacity, b.opacity) > COVERED)
        for a, b in zip(found, wanted, strict=True)
    ]


@dataclass
class Trip:
    """One world's round trip through a format.

    Attributes:
        world: name of the world.
        size: size of the file, bytes.
        write, read: seconds of our writer and reader; None if another program does it.
        psnr: dB of each view, against the scene that went into the file.
        scene_psnr: dB against the original scene with kernels of degree 4 and signed normals.
        views: the first one as it came back, and as it was.
        equal: share of the PLY's values that came back bit by bit; None for other formats.
    """

    world: str
    size: int
    write: float | None
    read: float | None
    psnr: list[float]
    scene_psnr: list[float]
    views: tuple[np.ndarray, np.ndarray]
    equal: float | None = None


def exchange(
    each: Exchanged,
    convert: Convert,
    scene: GaussianScene,
    seen: Baked,
    plain: Sequence[Drawn],
    own: Sequence[Drawn],
    folder: Path,
) -> Trip:
    """Take a scene through a file of a format and another program.

    Args:
        each: the format.
        convert: ``convert`` of the format's reader.
        scene: scene to write.
        seen: the same world in the frame of the file.
        plain: its views with kernels of degree 2.
        own: its views as it is.
        folder: for the files.

    Raises:
        TronError: the file cannot be written or read, by us or by the other program.
    """
    file, other = folder / f"{each.name}{each.suffix}", folder / f"{each.name}_read.ply"
    write = read = equal = None
    if each.ours:
        write = _median_seconds(lambda: write_splats(file, scene))
        read = _median_seconds(lambda: GaussianScene.load(file))
        convert(file, other)
        found = GaussianScene.load(other)
        equal = equal_share(file, other) if each.name == "ply" else None
    else:
        write_splats(other, scene)
        convert(other, file)
        read = _median_seconds(lambda: GaussianScene.load(file))
        found = GaussianScene.load(file)
    if len(found) != len(scene):
        raise TronError(f"{len(found)} splats of {len(scene)} came back", file)
    drawn = draw(found, seen.cameras)
    views = drawn[0].image, plain[0].image
    size = file.stat().st_size
    return Trip(seen.name, size, write, read, alike(drawn, plain), alike(drawn, own), views, equal)


def equal_share(file: Path, other: Path) -> float:
    """Return the share of a PLY's values that equal another PLY's bit by bit, in the same rows."""
    first, second = (plyfile.PlyData.read(str(each))["vertex"].data for each in (file, other))
    names = [name for name in first.dtype.names if name not in ("nx", "ny", "nz")]
    if len(first) != len(second) or not set(names) <= set(second.dtype.names):
        return 0.0
    same = [first[n].astype("<f4").view("<u4") == second[n].astype("<f4").view("<u4") for n in names]
    return float(np.mean(same))


@dataclass
class Splats:
    """Figures of all worlds.

    Attributes:
        trips: format -> a trip for each world.
        degree2, both_sides, rasteriser, rasteriser_scene: world -> dB of each view.
        pictures: of the first world.
        lacking: format -> why it was not exchanged.
    """

    trips: dict[str, list[Trip]] = field(default_factory=dict)
    degree2: dict[str, list[float]] = field(default_factory=dict)
    both_sides: dict[str, list[float]] = field(default_factory=dict)
    rasteriser: dict[str, list[float]] = field(default_factory=dict)
    rasteriser_scene: dict[str, list[float]] = field(default_factory=dict)
    pictures: list[Pictures] = field(default_factory=list)
    lacking: dict[str, str] = field(default_factory=dict)

    def rows(self, seed: int) -> Iterator[Row]:
        """Yield means over worlds, with intervals drawn by ``seed``."""
        for name in ("degree2", "both_sides"):
            if found := getattr(self, name):
                yield mean_row(f"format.{name}.psnr", "dB", _by_world(found), seed)
        for name, trips in self.trips.items():
            views = {trip.world: trip.psnr for trip in trips}
            yield mean_row(f"format.{name}.psnr", "dB", _by_world(views), seed)
            whole = {trip.world: trip.scene_psnr for trip in trips}
            yield mean_row(f"format.{name}.scene_psnr", "dB", _by_world(whole), seed)
            plain: dict[str, tuple[str, list[float | None]]] = {
                "bytes": ("bytes", [trip.size for trip in trips]),
                "write_seconds": ("s", [trip.write for trip in trips]),
                "read_seconds": ("s", [trip.read for trip in trips]),
                "bit_equal": ("fraction", [trip.equal for trip in trips]),
            }
            for measure, (unit, values) in plain.items():
                held = [value for value in values if value is not None]
                if held:
                    mean = float(np.mean(held))
                    yield Row(metric=f"format.{name}.{measure}", value=mean, unit=unit, n=len(held))
        if self.rasteriser:
            yield mean_row("rasteriser.psnr", "dB", _by_world(self.rasteriser), seed)
            yield mean_row("rasteriser.scene_psnr", "dB", _by_world(self.rasteriser_scene), seed)


def measure_splats(
    worlds: int, surfels: int, seed: int, programs: Mapping[str, Reader], outcome: Outcome
) -> None:
    """Take every world through every format, and through a rasteriser of 3DGS.

    Args:
        worlds: number of worlds to draw.
        surfels: approximate number of surfels of each.
        seed: root of all random numbers.
        programs: of :func:`find_readers`.
        outcome: takes rows, pictures, and what could not be measured.
    """
    found = Splats()
    for number in range(worlds):
        world = Baked.drawn(number, surfels, seed)
        with tempfile.TemporaryDirectory(prefix="tron-") as folder:
            _measure_world(world, programs, found, Path(folder))
    outcome.add(found.rows(seed))
    for name, why in found.lacking.items():
        for measure in ("psnr", *(["bit_equal"] if name == "ply" else [])):
            outcome.lack(f"format.{name}.{measure}", why)
    for number, group in enumerate(found.pictures):
        outcome.show("formats", f"formats-{number}", group)


def _measure_world(world: Baked, programs: Mapping[str, Reader], found: Splats, folder: Path) -> None:
    own, plain = draw(world.scene, world.cameras), draw(world.plain, world.cameras)
    kernel = draw(with_kernel(world.scene, 2), world.cameras)
    found.degree2[world.name], found.both_sides[world.name] = alike(kernel, own), alike(plain, kernel)
    standing = world.standing()
    stood_plain, stood_own = (draw(each, standing.cameras) for each in (standing.plain, standing.scene))
    frames = {False: (world, plain, own), True: (standing, stood_plain, stood_own)}
    first = not found.pictures
    shown = [
        ("kernel of degree 2", kernel[0].image, own[0].image, found.degree2[world.name][0]),
        ("seen from both sides", plain[0].image, kernel[0].image, found.both_sides[world.name][0]),
    ]
    for each in FORMATS:
        program = programs[each.reader]
        if program.convert is None:
            found.lacking[each.name] = program.why
            continue
        convert = program.convert
        try:
            trip = exchange(each, convert, world.scene, *frames[each.stands], folder)
        except TronError as error:
            found.lacking[each.name] = f"{world.name}: {error}"
            continue
        log.info("%s, %s: %.1f dB, %d bytes", world.name, each.name, trip.psnr[0], trip.size)
        found.trips.setdefault(each.name, []).append(trip)
        title = (
            f"{each.suffix} by {program.name}" if not each.ours else f"{each.suffix}, read by {program.name}"
        )
        shown.append((title, *trip.views, trip.psnr[0]))
    file = folder / "rasterised.ply"
    write_splats(file, world.scene)
    drawn = [averaged(np.clip(rasterise(file, _fine(c))[0], 0, 1), FINENESS) for c in world.cameras]
    other = [Drawn(image, view.opacity) for image, view in zip(drawn, plain)]
    found.rasteriser[world.name] = alike(other, plain)
    found.rasteriser_scene[world.name] = alike(other, own)
    shown.append(("3DGS rasteriser", drawn[0], plain[0].image, found.rasteriser[world.name][0]))
    if first:
        found.pictures = list(_pictures(own[0].image, shown))


def _pictures(
    own: np.ndarray, shown: Sequence[tuple[str, np.ndarray, np.ndarray, float]]
) -> Iterator[Pictures]:
    """Show the scene, every variant that differs from it, and the differences."""
    differing = [each for each in shown if not np.array_equal(each[1], each[2])]
    pictures = [Picture(own, "the scene", "the scene, kernel of degree 4", strong=True)]
    changes = []
    for title, image, against, psnr in differing:
        pictures.append(Picture(image, title, f"the scene, {title}", f"{psnr:.1f} dB"))
        change = np.clip(0.5 + MAGNIFIED * (image - against), 0, 1)
        changes.append(Picture(change, title, f"{MAGNIFIED} times the change by {title}", f"{psnr:.1f} dB"))
    yield Pictures("The first world through every format that changes it", pictures, columns=4)
    if changes:
        note = (
            f"Differences {MAGNIFIED} times as strong, around grey: of degree 2 from the scene, of both "
            "sides from degree 2, else from both sides."
        )
        yield Pictures("What changes", changes, note, columns=4)


def _by_world(found: Mapping[str, Sequence[float]]) -> list[tuple[str, float]]:
    return list(chain.from_iterable([(world, value) for value in values] for world, values in found.items()))


def _fine(camera: Camera) -> Camera:
    return camera.resized(FINENESS * camera.width, FINENESS * camera.height)


def _median_seconds(work: Callable[[], object]) -> float:
    taken = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))

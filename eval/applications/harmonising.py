"""Insert a thing into a capture under the capture's light, and compare with pasting its photograph.

Two worlds under different lights. The thing stands in both at one place before one camera, so that its
photograph in the other world fits into the capture's picture to the pixel. Ours inserts its surfels by
``tron-edit`` and lights all of it by the capture's light, as ``tron-relight environment=capture`` does. Truth
is path tracing of capture and thing together. The capture's light and materials are the true ones: the
insertion is judged, not the reconstruction. A second run takes light and materials from the joint fit of
`tron-reconstruct` to path-traced photos of the capture, on the true geometry.

The rival is cut and paste: true photographs of capture and thing, each exposed for its own light, composited
by the true coverage without colour correction. Pasting has errors only at the thing and where the thing
changes the light; our picture has the blur of surfels everywhere. So only pixels at the thing, and pixels
where the thing changes the truth, are judged.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter

from eval.applications.worlds import GROUND, World, draw_thing, draw_world, moved, surfels_of, view_of
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.tracing.scene import LIGHTS
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import to_display
from tron.editing import EditList, Insert
from tron.estimation import QUALITY
from tron.gaussians.scene import GaussianScene
from tron.metrics import capped_psnr
from tron.reconstruction.materials.joint_fit import JointSettings, fit_jointly
from tron.relighting import Relighter
from tron.report.page import Picture, Pictures
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap
from tron.trajectories import film_around

WORLDS, SIDE, PATHS = 6, 192, 256
"""Pairs of worlds, pixels along a side, and paths a pixel of truths and photographs."""
SURFELS = 40_000
"""Of the capture; the thing's have the same spacing."""
CHANGED = 0.02
"""Largest change of a channel, display values, mean of 3 x 3 pixels, where the thing changes the light."""
PHOTOS, PHOTO_SIDE, PHOTO_PATHS = 24, 128, 64
"""Photographs of a capture that its light is found from: number, pixels along a side, paths a pixel."""
MATTE = 4
"""Sub-pixels along a pixel's side that its covered share is counted on."""
QUALITIES = {"": QUALITY["preview"], "final_": QUALITY["final"]}
"""Beginning of a row -> ``quality`` of tron-relight; preview is its default."""
METHODS = {
    "": "ours, preview",
    "final_": "ours, final",
    "fitted_": "ours, fitted light",
    "pasted_": "pasted in",
}
"""Beginning of a row -> title of a picture that is judged."""
TRUTH = "path-traced"


@dataclass(frozen=True)
class Composite:
    """One pair of worlds.

    Attributes:
        name: name of the pair.
        images: title -> display values (H, W, 3), in the order of the page.
        thing: (H, W) bool, pixels that show it. cast: pixels where it changes the light.
    """

    name: str
    images: dict[str, np.ndarray]
    thing: np.ndarray
    cast: np.ndarray


def measure_harmonising(seed: int, outcome: Outcome) -> None:
    """Composite all pairs; add figures and pictures."""
    found = []
    for number in range(WORLDS):
        found.append(composite(seed, number))
        outcome.show("harmonise", f"harmonise-{number}", _pictures(found[-1]))
    outcome.add(harmonising_rows(found, seed))


def harmonising_rows(found: Sequence[Composite], seed: int) -> Iterator[Row]:
    """Yield PSNR of inserting and of pasting on judged pixels, at and beside the thing, and the gains."""
    gains = {}
    for prefix, title in METHODS.items():
        for part, where in (("", "judged"), ("thing_", "thing"), ("cast_", "cast")):
            values = [
                (each.name, capped_psnr(each.images[title], each.images[TRUTH], pixels))
                for each in found
                if (pixels := judged(each) if where == "judged" else getattr(each, where)).any()
            ]
            gains[prefix, part] = [value for _, value in values]
            yield mean_row(f"harmonise.{prefix}{part}psnr", "dB", values, seed)
    for prefix in ("", "fitted_"):
        pairs = zip(gains[prefix, ""], gains["pasted_", ""], strict=True)
        gain = [(each.name, ours - pasted) for each, (ours, pasted) in zip(found, pairs, strict=True)]
        yield mean_row(f"harmonise.{prefix}gain", "dB", gain, seed)
        for name, value in gain:
            yield Row(metric=f"harmonise.{prefix}world_gain.{name}", value=value, unit="dB", n=1)


def judged(found: Composite) -> np.ndarray:
    """(H, W) bool: pixels of the thing, and pixels where it changes the light."""
    return found.thing | found.cast


def composite(seed: int, number: int) -> Composite:
    """Composite a pair of worlds; one is under a sun and the other in soft light, in turns."""
    rng = generator(seed, "applications", "harmonise", number, "thing")
    kinds = list(LIGHTS)
    capture, other = (
        draw_world(seed, f"harmonise {what}", number, kinds[(number + k) % 2])
        for k, what in enumerate(("capture", "other"))
    )
    thing = draw_thing(rng)
    at, turn = rng.uniform(-0.15, 0.15, 2), float(rng.uniform(0, 360))
    camera = view_of(rng, SIDE, SIDE)
    placed = moved(thing, (*at, 0.0), turn)
    whole, photographed = (replace(each, parts=(*each.parts, placed)) for each in (capture, other))
    paths = integer(seed, "applications", "harmonise", number, "paths")

    def photograph(world: World) -> np.ndarray:
        return to_display(world.traced(camera, PATHS, paths), world.light.exposure())

    truth, before, photo = (photograph(world) for world in (whole, capture, photographed))
    share = covered(whole, camera)[..., None]
    spacing, seeded = np.sqrt(capture.area / SURFELS), integer(seed, "applications", "harmonise", number)
    empty, put = capture.surfels(SURFELS), surfels_of([thing], float(spacing), capture.seed)
    found = fitted(capture, empty, seeded)
    images = {
        "the thing, its own light": photo,
        "the capture": before,
        METHODS["pasted_"]: share * photo + (1 - share) * before,
    }
    true = empty, capture.light
    for prefix, (scene, light) in {**dict.fromkeys(QUALITIES, true), "fitted_": found}.items():
        both, estimation = inserted(scene, put, at, turn), QUALITIES.get(prefix, QUALITIES[""])
        lit = Relighter(both, estimation, seeded, proxy="never").under(light).render(camera).lit
        images[METHODS[prefix]] = to_display(lit, capture.light.exposure())
    change, shown = uniform_filter(np.abs(truth - before).max(-1), 3), share[..., 0] > 0
    images[TRUTH] = truth
    return Composite(
        f"pair{number}", images, shown, (change > CHANGED) & ~np.asarray(binary_dilation(shown), bool)
    )


def fitted(capture: World, scene: GaussianScene, seed: int) -> tuple[GaussianScene, EnvironmentMap]:
    """Return a capture's surfels with materials fitted to its photographs, and the fitted light.

    Args:
        capture: world to photograph.
        scene: surfels of the capture; their materials are ignored.
        seed: root of the random numbers of the photographs and of the fit.
    """
    exposure, views = capture.light.exposure(), []
    for number, camera in enumerate(film_around(scene, PHOTOS, PHOTO_SIDE)):
        photo = capture.traced(camera, PHOTO_PATHS, integer(seed, "photographs", number))
        views.append(View(f"{number}", camera, to_display(photo, exposure), "display"))
    photos = Capture(tuple(views), exposure=exposure, tone_curve="agx")
    fit = fit_jointly(photos, scene, JointSettings(same_exposure=True), seed)
    return fit.scene, fit.environment


def inserted(scene: GaussianScene, thing: GaussianScene, at: np.ndarray, turn_deg: float) -> GaussianScene:
    """Return the scene after an ``insert`` of `tron-edit`: the thing stands on the surface below a point."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "thing.ply"
        thing.save(file)
        edit = Insert(file=file, at=(float(at[0]), float(at[1]), 2.0), turn=turn_deg)
        return EditList((edit,)).apply(scene)


def covered(world: World, camera: Camera) -> np.ndarray:
    """Return the share of each pixel that shows the last part of a world, (H, W)."""
    fine = world.surface(camera.resized(MATTE * camera.width, MATTE * camera.height)).number
    last = fine == GROUND + len(world.parts) - 1
    return last.reshape(camera.height, MATTE, camera.width, MATTE).mean((1, 3))


def _pictures(found: Composite) -> Pictures:
    pictures = []
    for title, image in found.images.items():
        mine = title in METHODS.values()
        figure = f"{capped_psnr(image, found.images[TRUTH], judged(found)):.1f} dB" if mine else ""
        pictures.append(Picture(image, title, f"{title}, {found.name}", figure, strong=title == METHODS[""]))
    region = np.where(judged(found)[..., None], found.images[TRUTH], 0.15)
    pictures.append(Picture(region, "judged pixels", f"pixels that are judged, {found.name}"))
    return Pictures(found.name, pictures, columns=len(pictures))

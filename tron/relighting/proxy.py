"""A proxy for light: one layer of oriented surfels in place of a scan that is thick.

Scans of 3DGS are fog: along a camera ray the way from where a tenth of the light is gone to where half is
(``Surface.lift``) is 2 to 3 spacings in real ones, 0 to 0.2 in clean surfels. Such layers shadow one another,
and their normals mean little. So the scan is filmed once, its median depths are fused
(:mod:`tron.tracing.fusion`), and what the views agree on becomes one layer of surfels. Each has the
materials of the splats around it, so that another paint asks for no film. Light sees the proxy, cameras see
the scan. A pixel is put together from both:

    R, S       what the camera sees of the scan, of the proxy
    use S      where it is opaque, and no farther than 4 voxels behind R: holes of the scan take S too
    position   S, else R + 1 spacing along the normal
    normal     S, else that of each surfel's nearest proxy surfel, turned to the camera
    values     of bounced light: S, else those of the nearest proxy surfel
    materials  R, and its opacity
    shadows    T_S(x, w), and beyond 4 voxels the scan's own T_R(x + 4 v w, w) too

A pixel of the rule, ``thick``, is one of eight views around, opaque, with a lift above one spacing. Their
share is 0.00 to 0.03 of clean surfels, 0.04 to 0.09 of reconstructed photographs, which gain 0.0 to 1.1 dB
of their relit pictures by a proxy (five development captures), 0.7 to 0.8 of real scans.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree
from scipy.special import expit, softmax

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.fields import FIELDS, MATERIALS
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.kept import made_as_now
from tron.gaussians.neighbours import alike_neighbours
from tron.gaussians.ply import header_comments, write_ply
from tron.gaussians.projections import DISKS
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.runtime import aligned
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.fusion import DepthMap, consensus, empty_rays, fuse, pixel_footprint
from tron.tracing.hierarchy.first_hit import FirstHit
from tron.tracing.hierarchy.transmittance import Fans
from tron.tracing.surface import Surface, centres, seen_normal
from tron.trajectories import film_around, film_with

Choice = Literal["auto", "always", "never"]

THICK = 0.03
"""Share of thick pixels from which a proxy gains."""
_THICK_VIEWS, _THICK_SIDE, _OPAQUE = 8, 256, 0.99
VIEWS, SIDE, MOST_VOXELS, TRUNCATION, SIGMA, SURFELS = 64, 300, 256, 4.0, 1.0, 60_000
"""Number of rendered views, most pixels of their sides, most voxels along the longest side, truncation and
sigma of :mod:`tron.tracing.fusion`, most surfels. Coarser voxels leak, finer ones keep the scan's noise."""
_LEAST_SIDE, _PIXELS_PER_SPLAT = 64, 2.0
_SOLID = 0.5
_PITS = 3
"""Voxels to either side up to which a pit is closed. Behind fog median depths lie too deep here and there."""
_NEAR_VOXELS = 4.0
"""Voxels up to which light sees the proxy alone, and by which the proxy may lie behind the scan."""
_EVENED, _ALIKE, _MOST_EVENED = 6.0, 0.8, 200
"""Deviation in spacings of the Gaussian that normals are evened by, least cosine of those that count, and how
many neighbours at most."""
_LENDERS, _ACROSS, _OUTWARD = 32, 1.4, 3.0
"""Splats that lend a surfel their materials, deviation in spacings of the Gaussian about its normal, and
spacings along it after which a splat counts e times as much: cameras see the outer ones. What the film's
pixels show differs by 0.04 (biker, mean of base color), and frames by 57 to 71 dB: it is bounced light's."""
_MADE = "of these views and voxels, closed, normals evened, materials of the splats around"


@dataclass(frozen=True, eq=False)
class Proxy:
    """One layer of surfels on which light is computed.

    Attributes:
        surfels: oriented, with the scan's materials, in its world.
        voxel: edge of the fused field's voxels, world units.
        lent: what :func:`lenders` gives, once it was asked for.
    """

    surfels: GaussianScene
    voxel: float
    lent: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)

    def painted(self, scan: GaussianScene) -> Proxy:
        """Return the proxy with the materials of a scan that has the same geometry as the proxy's scan."""
        lent = lenders(self.surfels, scan) if self.lent is None else self.lent
        numbers, weights = lent
        names = (*MATERIALS, "emission")
        found = {name: np.einsum("mk,mk...->m...", weights, getattr(scan, name)[numbers]) for name in names}
        found |= {name: np.clip(found[name], 0, 1) for name in MATERIALS}
        return replace(self, surfels=replace(self.surfels, **found), lent=lent)

    def save(self, path: Path, made_from: str) -> None:
        """Write a PLY that names its source by :func:`fingerprint`.

        Raises:
            TronError: the file cannot be written.
        """
        comments = [f"tron voxel {self.voxel!r}", f"proxy {made_from}"]
        values = vars(self.surfels) | {"normals": self.surfels.normals()}
        write_ply(path, values, comments)

    @classmethod
    def load(cls, path: Path, made_from: str) -> Proxy | None:
        """Read :meth:`save`'s file; None if it is missing or was made from another source."""
        comments = header_comments(path)
        voxels = [said.split()[2] for said in comments if said.startswith("tron voxel ")]
        if not made_as_now(path, f"proxy {made_from}") or not voxels:
            return None
        try:
            return cls(GaussianScene.load(path), float(voxels[0]))
        except (ValueError, TronError):
            return None


def fingerprint(scene: GaussianScene, cameras: Sequence[Camera] | None) -> str:
    """Return a hexadecimal digest of everything that a proxy depends on."""
    digest = hashlib.sha256(_MADE.encode())
    for name in FIELDS:
        if name != "emission" or scene.emission.any():  # proxies of before know of none
            digest.update(np.ascontiguousarray(getattr(scene, name)).tobytes())
    seen = () if scene.projection == DISKS else (scene.projection,)
    digest.update(repr((scene.kernel_degree, scene.oriented, scene.up.tolist(), *seen)).encode())
    for camera in cameras or ():
        digest.update(repr(camera.to_dict()).encode())
    return digest.hexdigest()


def thickness(tracer: SurfelTracer, cameras: Sequence[Camera] | None = None) -> float:
    """Return the share of opaque pixels whose lift exceeds one spacing; 0 if no pixel is opaque.

    Args:
        tracer: of the scan.
        cameras: that it was filmed with; None: around it.
    """
    lifts = []
    for camera in _film(tracer.scene, cameras, _THICK_VIEWS, _THICK_SIDE):
        view = seen_by(tracer, camera)
        images = view.images({"lift": view.lift, "opacity": view.opacity})
        lifts.append(images["lift"][images["opacity"] > _OPAQUE])
    every = np.concatenate(lifts)
    return float((every > tracer.scene.spacing).mean()) if len(every) else 0.0


def make_proxy(
    tracer: SurfelTracer,
    cameras: Sequence[Camera] | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> Proxy | None:
    """Render a scan from many views, fuse depths, cover them with surfels; None if views find no surface.

    Args:
        tracer: of the scan.
        cameras: that it was filmed with, of which some are taken; None: around it.
        track: wraps the loop over the views, to show progress.
    """
    scene, maps = tracer.scene, []
    side = min(max(round((_PIXELS_PER_SPLAT * len(scene)) ** 0.5), _LEAST_SIDE), SIDE)
    film = _film(scene, cameras, VIEWS, side)
    for number in track(range(len(film))):
        view = seen_by(tracer, film[number])
        images = view.images({"depth": view.depth, "opacity": view.opacity})
        depth, subject = images["depth"], images["opacity"] > _SOLID
        maps.append(DepthMap(film[number], depth, subject & (depth > 0), empty_rays(subject)))
    fused = fuse(maps, pixel_footprint(maps), TRUNCATION, MOST_VOXELS)
    if fused is None:
        return None
    agreed = consensus(fused.closed(_PITS), maps, SIGMA)
    if not any((depth > 0).any() for depth, _ in agreed):
        return None
    surfels = surfels_from_gbuffers(_layer(film, agreed), min(SURFELS, 2 * len(scene)))
    surfels.up, surfels.offset = scene.up, scene.offset
    return Proxy(evened(surfels), fused.voxel).painted(scene)


def lenders(surfels: GaussianScene, scan: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Find the splats that give P proxy surfels their materials: (P, K) numbers, and weights that sum to 1.

    The nearest, each by its opacity, its area, its distance across the normal and how far out it lies.
    """
    place, normals = surfels.means.astype(np.float64), surfels.normals()
    count = min(_LENDERS, len(scan))
    numbers = np.asarray(KDTree(scan.means).query(place, k=count)[1]).reshape(len(place), count)
    way = scan.means[numbers] - place[:, None]
    out = np.einsum("mkj,mj->mk", way, normals)
    across = np.maximum((way**2).sum(-1) - out**2, 0)
    shown = expit(scan.opacity_logits) * np.exp(scan.log_scales.sum(1))
    log_weights = np.log(np.maximum(shown, 1e-30))[numbers]
    log_weights += out / (_OUTWARD * surfels.spacing) - 0.5 * across / (_ACROSS * surfels.spacing) ** 2
    weights = softmax(log_weights, axis=1)
    return numbers, weights.astype(np.float32)


def evened(surfels: GaussianScene) -> GaussianScene:
    """Smooth the normals of surfels over neighbours that face the same way.

    Splats of something smooth and plain, such as a white pot, lie at depths that wander, and light would show
    each wave. Edges stay.
    """
    numbers, weights = alike_neighbours(surfels, _MOST_EVENED, _EVENED, _ALIKE)
    even = np.einsum("mk,mki->mi", weights, surfels.normals()[numbers])
    even /= np.linalg.norm(even, axis=1, keepdims=True)
    return replace(surfels, quats=quats_from_normals(even).astype(np.float32))


def _layer(film: Sequence[Camera], agreed: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterator[GBufferView]:
    """The views of the surface; its materials are not theirs."""
    for camera, (depth, normal) in zip(film, agreed, strict=True):
        position = (camera.position + depth[..., None] * camera.rays()).astype(np.float32)
        none, nowhere = np.zeros(depth.shape, np.float32), np.zeros(depth.shape, int)
        black = np.broadcast_to(none[..., None], (*depth.shape, 3))
        yield GBufferView(camera, position, normal, black, none, none, None, depth > 0, nowhere)


def _film(scene: GaussianScene, cameras: Sequence[Camera] | None, views: int, side: int) -> list[Camera]:
    """Some ``views`` of the cameras, evenly, with images of ``side`` at most; without any: around."""
    return film_with(cameras, views, side) if cameras else film_around(scene, views, side)


def seen_by(tracer: SurfelTracer, camera: Camera) -> GBuffer:
    """Trace a camera's G-buffer; surfels whose normals have no sign are turned to face the camera."""
    scene = tracer.scene
    if not scene.oriented:
        tracer = tracer.turned_over(scene.looks_away(camera.position))
    return tracer.gbuffer(camera)


class ProxiedTracer:
    """Camera rays hit scan and proxy, other rays the proxy; has the interface of ``SurfelTracer``.

    Args:
        scan: as a camera sees it.
        light: the proxy's surfels.
        voxel: of the proxy, world units.
        backdrop: (M,) bool, surfels of the scan that the proxy does not stand for.

    Attributes:
        light: the surfels that light sees. scene, records: theirs, whom :meth:`first_hits` numbers.
    """

    def __init__(
        self, scan: SurfelTracer, light: SurfelTracer, voxel: float, backdrop: np.ndarray | None = None
    ) -> None:
        self._scan, self.light, self._near = scan, light, _NEAR_VOXELS * voxel
        self.scene, self.records = light.scene, light.records
        sides = _sides(scan.scene.means, light.scene, self._near)
        normals = [light.scene.normals()[side] for side in sides]
        for each in normals if backdrop is not None else ():
            each[backdrop] = scan.scene.normals()[backdrop]
        self._sides = [mi.UInt32(aligned(np.asarray(side, np.uint32))) for side in sides]
        self._normals = [mi.Vector3f(*(mi.Float(aligned(axis)) for axis in each.T)) for each in normals]

    def showing(self, scan: SurfelTracer) -> ProxiedTracer:
        """Return a copy for a camera that sees other sides of the scan's surfels."""
        other = copy(self)
        other._scan = scan
        return other

    def painted(self, scan: SurfelTracer, surfels: GaussianScene) -> ProxiedTracer:
        """Return a copy for a scan and a proxy that differ only in materials."""
        other = copy(self)
        other._scan, other.light = scan, self.light.moved(surfels)
        other.scene, other.records = other.light.scene, other.light.records
        return other

    def sided(self, two_sided: bool) -> ProxiedTracer:
        """Return a copy with other blocking sides for shadow rays: :meth:`SurfelTracer.sided`."""
        other = copy(self)
        other._scan, other.light = self._scan.sided(two_sided), self.light.sided(two_sided)
        return other

    def gbuffer(
        self, camera: Camera, values: Sequence[mi.Float] = (), limit: mi.Float | None = None
    ) -> GBuffer:
        """Trace the camera's G-buffer of the scan, with points on the proxy; ``values`` are the proxy's.

        ``limit`` as of :meth:`SurfelTracer.gbuffer`.
        """
        eye, near = mi.Point3f(*(float(v) for v in camera.position)), dr.opaque(mi.Float, self._near)
        dr.make_opaque(eye)
        # Where a leaf's near side has a hole in the proxy, light on the far side is none of its own.
        nearest, other = self._normals
        splat = dr.arange(mi.UInt32, len(self._scan.scene))
        towards = mi.Vector3f(eye - centres(self._scan.records, splat).position)
        away = (dr.dot(nearest, towards) < 0) & (dr.dot(other, towards) > 0)
        carried = self._carried(values, dr.select(away, self._sides[1], self._sides[0]))
        scan = self._scan.gbuffer(camera, [*carried, *dr.select(away, other, nearest)], limit)
        proxy = self.light.gbuffer(camera, values, limit)
        use = proxy.opacity > _SOLID
        use &= dr.norm(proxy.position - eye) < dr.norm(scan.position - eye) + near
        normal = _towards(mi.Vector3f(*scan.values[-3:]), scan.direction, scan.normal)
        lifted = dr.fma(dr.opaque(mi.Float, self.scene.spacing), normal, scan.position)
        own = scan.values[: len(carried)]
        merged = replace(
            scan,
            position=dr.select(use, proxy.position, lifted),
            normal=mi.Normal3f(dr.select(use, proxy.normal, normal)),
            values=[dr.select(use, there, here) for there, here in zip(proxy.values, own, strict=True)],
        )
        dr.eval(merged)
        return merged

    def surfels(self, values: Sequence[mi.Float] = ()) -> Surface:
        """Return the scan's surfels at their centres, with normals and ``values`` of the proxy nearby."""
        found = centres(self._scan.records, dr.arange(mi.UInt32, len(self._scan.scene)))
        return replace(
            found, normal=mi.Normal3f(self._normals[0]), values=self._carried(values, self._sides[0])
        )

    def _carried(self, values: Sequence[mi.Float], lender: mi.UInt32) -> list[mi.Float]:
        return [dr.gather(mi.Float, value, lender) for value in values]

    def first_hits(
        self,
        origin: mi.Point3f,
        directions: Sequence[mi.Vector3f],
        active: Sequence[mi.Bool],
        seeds: Sequence[mi.UInt32],
        normal: mi.Vector3f | None = None,
    ) -> list[FirstHit]:
        """:meth:`SurfelTracer.first_hits` among the proxy's surfels."""
        return self.light.first_hits(origin, directions, active, seeds, normal)

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        """Return transmittances through the proxy, and beyond some voxels through the scan too."""
        near = self.light.transmittances(fans)
        off = dr.opaque(mi.Float, self._near)
        found = []
        for along, going, through in zip(fans.directions, fans.active, near, strict=True):
            rest = self._scan.transmittance(
                mi.Point3f(dr.fma(off, along, fans.origin)), along, going & (through > 0)
            )
            found.append(through * rest)
        return found


def _sides(points: np.ndarray, surfels: GaussianScene, near: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) numbers of the surfels nearest to points, and of those nearest that look the other way.

    The latter among points of space and direction: ``near`` away counts as a right angle does. Where none is
    that near and looks away from the nearest, it is the nearest.
    """
    normals = surfels.normals()
    nearest = np.asarray(KDTree(surfels.means).query(points)[1])
    apart = np.hypot(1, 1) / near
    tree = KDTree(np.concatenate([surfels.means * apart, normals], axis=1))
    other = np.asarray(tree.query(np.concatenate([points * apart, -normals[nearest]], axis=1))[1])
    there = np.linalg.norm(surfels.means[other] - points, axis=1) < near
    there &= np.einsum("nk,nk->n", normals[other], normals[nearest]) < 0
    return nearest, np.where(there, other, nearest)


def _towards(carried: mi.Vector3f, direction: mi.Vector3f, otherwise: mi.Normal3f) -> mi.Vector3f:
    """Unit normals, bent until rays along ``direction`` see them; ``otherwise`` where there are none."""
    squared = dr.squared_norm(carried)
    some = squared > 1e-6
    normal = dr.select(some, carried * dr.rsqrt(dr.select(some, squared, 1)), mi.Vector3f(otherwise))
    return seen_normal(normal, direction)

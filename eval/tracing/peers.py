"""Other renderers that the tracer is timed against, and one scene of surfels for all.

Camera rays: Mitsuba's ``volprim_rf_basic`` on its ellipsoids, with the same surfels. The shipped integrator
stops where transmittance falls below 0.01, which is written in its source. For equal work
:func:`load_integrator` can run that source with that number replaced; nothing else of it changes. What cannot
be made equal: its primitives are 3D Gaussians, here very flat ones, met in the order in which rays enter
their hulls; they have no front side, so both sides are composited; it gathers radiance alone, no normals,
materials or depths; and it starts again 1e-4 behind each hit, which skips primitives that nearly coincide. On
NVIDIA GPUs gsplat's rasteriser of 2D Gaussians besides, where it is installed (extra ``gpu-peers``): it
projects, composites both sides, ends at transmittance 1e-4, and gathers colour, normal and depth.

Single rays: Mitsuba's ray queries (Embree on a CPU, OptiX on a GPU) on quads around the part of a surfel's
ellipse that counts. One any hit is the least that a tracer of triangles spends on a shadow ray, and it is not
what the surfels need: it ignores opacity and sides, and stops at corners of quads that the ellipse does not
reach, mostly at the surface that the ray leaves. Mitsuba and Dr.Jit offer no program to be run at each hit,
so whoever wants all hits along a ray starts the query again behind each: :class:`RestartedShadows`.
"""

from __future__ import annotations

import importlib.util
import inspect
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.tracing.scene import surfels
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.runtime import aligned, lanes
from tron.tracing import SurfelTracer
from tron.tracing.compositing import STOP_TRANSMITTANCE
from tron.tracing.hierarchy.transmittance import OPAQUE_TRANSMITTANCE, BackFaces, blocks
from tron.tracing.kernel import GEOMETRY_PACKETS, intersect
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiled.tiles import TILE

SHAPES = ("ellipsoids", "ellipsoidsmesh")
"""Mitsuba's plugins for the primitives of ``volprim_rf_basic``."""
SHIPPED_STOP = 0.01
OUR_STOP = STOP_TRANSMITTANCE
THINNESS = 0.02
"""Third scale over the smaller of the surfel's two: as flat as the peer's own arithmetic bears."""
MAX_DEPTH = 128
_STOP_LINE = "dr.max(β) > 0.01"
RESTART_OFFSET = 1e-4
"""Distance behind a hit at which the next query starts, world units; Mitsuba's volprim uses it too."""
MAX_RESTARTS = 512


@dataclass
class Contenders:
    """The scene in the form of each renderer, built on first use; ``shape`` is one of SHAPES."""

    scene: GaussianScene
    shape: str = SHAPES[0]

    @classmethod
    def of(cls, count: int, seed: int, shape: str = SHAPES[0]) -> Contenders:
        """Return contenders for ``count`` drawn surfels."""
        return cls(surfels(count, seed), shape)

    @cached_property
    def tracer(self) -> SurfelTracer:
        """TRON's tracer with its hierarchy."""
        return SurfelTracer(self.scene)

    @cached_property
    def quads(self) -> mi.Scene:
        """A square around each surfel, for Mitsuba's ray queries."""
        return quads(self.scene)

    @cached_property
    def primitives(self) -> mi.Scene:
        """Flat ellipsoids for ``volprim_rf_basic``."""
        return primitives(self.scene, self.shape)


def camera_peers(contenders: Contenders, view: Camera) -> dict[str, Callable[[], Any]]:
    """Return name in metrics -> a call that renders one frame, for every peer that can run here.

    volprim renders one random ray per pixel, as a user would; the closest hit uses rays through pixel
    centres, tile after tile, without opacity, order or colour.
    """
    scene, sensed, (origin, direction) = contenders.quads, sensor(view), tile_rays(view)
    ours, shipped = load_integrator(OUR_STOP), load_integrator()
    peers: dict[str, Callable[[], Any]] = {
        "volprim": lambda: render(contenders.primitives, sensed, ours),
        "volprim_as_shipped": lambda: render(contenders.primitives, sensed, shipped),
        "embree_closest_hit": lambda: closest_hit(scene, origin, direction, coherent=True),
    }
    if gsplat_available():
        peers["gsplat"] = gsplat_frame(contenders.scene, view)
    return peers


def load_integrator(stop: float = SHIPPED_STOP) -> Any:
    """Load the shipped integrator, or its source with another stopping transmittance.

    Raises:
        TronError: this Mitsuba's source does not have the line to replace.
    """
    from mitsuba.ad.integrators import volprim_rf_basic as shipped  # pyright: ignore[reportMissingImports]

    name = "volprim_rf_basic"
    if stop != SHIPPED_STOP:
        name = f"volprim_rf_basic_{stop:g}"
        source = inspect.getsource(shipped)
        if source.count(_STOP_LINE) != 1:
            raise TronError("this Mitsuba's volprim_rf_basic ends rays in another way", shipped.__file__)
        source = source.replace(_STOP_LINE, f"dr.max(β) > {stop:g}")
        source = source.replace('register_integrator("volprim_rf_basic"', f'register_integrator("{name}"')
        _import_beside(shipped, source, name.replace(".", "_").replace("-", "_"))
    return mi.load_dict({"type": name, "max_depth": MAX_DEPTH, "srgb_primitives": False})


def _import_beside(shipped: Any, source: str, name: str) -> None:
    """Run changed source as a sibling of a module; Dr.Jit reads it again, so it must stand in a file."""
    package = shipped.__name__.rpartition(".")[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.py"
        path.write_text(source, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(f"{package}.{name}", path)
        assert spec is not None
        assert spec.loader is not None
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def primitives(scene: GaussianScene, shape: str = SHAPES[0]) -> mi.Scene:
    """Return the surfels as flat ellipsoids in a Mitsuba scene, with harmonics of degree 0."""
    scales = scene.scales()
    flat = np.concatenate([scales, THINNESS * scales.min(1, keepdims=True)], 1)
    tensors = {
        "centers": scene.means,
        "scales": flat,
        "quaternions": scene.quats[:, [1, 2, 3, 0]],
        "opacities": scene.opacities()[:, None],
        "sh_coeffs": scene.sh[:, 0],
    }
    columns = {name: mi.TensorXf(aligned(v.astype(np.float32))) for name, v in tensors.items()}
    return mi.load_dict({"type": "scene", "surfels": {"type": shape, "extent": 3.0, **columns}})


def sensor(camera: Camera) -> mi.Sensor:
    """Return the camera with a box filter and one sample per pixel."""
    return mi.load_dict(mitsuba_sensor(camera, spp=1))


def render(scene: mi.Scene, view: mi.Sensor, integrator: Any) -> mi.TensorXf:
    """Render one frame as a user would: one random ray per pixel."""
    return mi.render(scene, sensor=view, integrator=integrator, spp=1)


def through_centres(scene: mi.Scene, integrator: Any, camera: Camera) -> np.ndarray:
    """Render radiance (H, W, 3) float32 along rays through pixel centres, for comparison, not for timing."""
    rays = np.ascontiguousarray(camera.rays().reshape(-1, 3).T, np.float32)
    origin = dr.repeat(mi.Point3f([float(x) for x in camera.position]), rays.shape[1])
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(0, rays.shape[1])
    color, *_ = integrator.sample(
        dr.ADMode.Primal, scene, sampler, mi.Ray3f(origin, mi.Vector3f(rays)), None, None, mi.Bool(True)
    )
    return np.array(color).T.reshape(camera.height, camera.width, 3)


def quads(scene: GaussianScene) -> mi.Scene:
    """Return two triangles per surfel, 2 k and 2 k + 1 for surfel k, in a Mitsuba scene with hierarchy."""
    geometry = pack(SurfelParameters.from_scene(scene)).geometry
    # The twelfth float of a surfel's record is the squared radius that counts, in sigmas.
    reach = np.sqrt(np.maximum(np.array(geometry).reshape(len(scene), 4 * GEOMETRY_PACKETS)[:, 11], 0.0))
    tangent_u, tangent_v = scene.tangents()
    scales = scene.scales() * reach[:, None]
    a, b = tangent_u * scales[:, :1], tangent_v * scales[:, 1:]
    corners = scene.means[:, None] + np.stack([-a - b, a - b, a + b, b - a], 1)
    first = 4 * np.arange(len(scene))[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]])
    mesh = mi.Mesh("quads", 4 * len(scene), 2 * len(scene))
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.ascontiguousarray(corners, np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    return mi.load_dict({"type": "scene", "quads": mesh})


def tile_rays(view: Camera) -> tuple[mi.Point3f, mi.Vector3f]:
    """Return rays through pixel centres in the order of 4 x 4 tiles, the best order for packets."""
    tiles = view.rays().reshape(view.height // TILE, TILE, view.width // TILE, TILE, 3)
    rays = tiles.transpose(0, 2, 1, 3, 4).reshape(-1, 3)
    origin = dr.repeat(mi.Point3f([float(x) for x in view.position]), len(rays))
    direction = lanes(mi.Vector3f, rays)
    dr.eval(origin, direction)
    return origin, direction


def closest_hit(
    scene: mi.Scene,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    active: mi.Bool | bool = True,
    coherent: bool = False,
) -> mi.Float:
    """Return the distance of the nearest quad along each ray, infinite if there is none."""
    ray, flags = mi.Ray3f(origin, direction), (mi.Bool(coherent), mi.Bool(active))
    return scene.ray_intersect_preliminary(ray, *flags).t


def any_hit(
    scene: mi.Scene, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool | bool = True
) -> mi.Bool:
    """Whether a quad lies anywhere along each ray."""
    return scene.ray_test(mi.Ray3f(origin, direction), coherent=mi.Bool(False), active=mi.Bool(active))


class RestartedShadows:
    """Transmittance by restarted closest-hit queries, with TRON's rules as far as restarts allow.

    Front faces count from the origin, back faces beyond two spacings, a ray ends below 0.01. Restarts miss
    surfels within ``RESTART_OFFSET`` behind another hit.
    """

    def __init__(self, scene: GaussianScene, traced: mi.Scene) -> None:
        self._traced = traced
        records = pack(SurfelParameters.from_scene(scene))
        self._geometry = records.geometry
        self._degree = scene.kernel_degree
        self._back_faces = BackFaces.of(records, scene.spacing)
        dr.eval(self._geometry)

    @dr.syntax
    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Float:
        """Return the product of (1 - alpha) over the surfels on each ray; exactly 0 below 0.01."""
        product, travelled, queries = mi.Float(1), mi.Float(0), mi.UInt32(0)
        going = mi.Bool(True)
        while going:
            ray = mi.Ray3f(origin + travelled * direction, direction)
            found = self._traced.ray_intersect_preliminary(ray, coherent=mi.Bool(False), active=going)
            going &= found.is_valid()
            surfel = dr.select(going, found.prim_index >> 1, 0)
            hit = intersect(self._geometry, surfel, origin, direction, self._degree)
            counts = going & blocks(hit, self._back_faces, mi.Vector3f(0))
            product = dr.select(counts, product * (1 - hit.alpha), product)
            travelled = dr.select(going, travelled + found.t + RESTART_OFFSET, travelled)
            queries += 1
            going &= (product >= OPAQUE_TRANSMITTANCE) & (queries < MAX_RESTARTS)
        return dr.select(product >= OPAQUE_TRANSMITTANCE, product, 0)


def gsplat_available() -> bool:
    """Whether gsplat is installed, torch sees a GPU, and the tracer runs on it too."""
    if not (mi.variant() or "").startswith("cuda") or importlib.util.find_spec("gsplat") is None:
        return False
    import torch

    return torch.cuda.is_available()


def gsplat_frame(scene: GaussianScene, camera: Camera) -> Callable[[], Any]:
    """Return a call that renders one frame with harmonics of degree 0 and waits for the device."""
    import torch
    from gsplat import rasterization_2dgs  # pyright: ignore

    def device(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).cuda()

    scales = scene.scales()
    arguments = {
        "means": device(scene.means),
        "quats": device(scene.quats),
        "scales": device(np.concatenate([scales, np.ones_like(scales[:, :1])], 1)),
        "opacities": device(scene.opacities()),
        "colors": device(scene.sh[:, :1]),
        "sh_degree": 0,
        "viewmats": device(camera.world_to_camera)[None],
        "Ks": device(np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]))[None],
        "width": camera.width,
        "height": camera.height,
    }

    def render() -> None:
        with torch.no_grad():
            rasterization_2dgs(**arguments)
        torch.cuda.synchronize()

    return render

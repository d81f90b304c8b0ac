"""Time of each task of the tracer beside the user's alternative, and rows of the times.

Camera rays: frames. Shadow rays come in two sets. Random ones leave the visible surface under
cosine-distributed directions of their own: the worst case of every packet tracer. The others are the rays of
the irradiance pass, in its order: the pass runs with another occluder. The time without tracing is measured
with no occluder, and subtracted from both sides.

A gradient step renders, compares with a grey image by L2 and differentiates by every parameter of the
surfels. TRON's packs the parameters, bins, traces and replays, and differentiates means, quaternions,
log-scales, logits, harmonics and materials; the peer's, through ``mi.render`` and ``dr.backward``, its
ellipsoids' centres, scales, quaternions, opacities and harmonics. The peer's hierarchy is fixed: rebuilding
it after a step is not counted.

Bounced light: transport is traced once per scene, a light is baked once, and a frame composites the bake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.results import Row
from eval.timing import Timed, format_count, interleaved
from eval.tracing import peers
from eval.tracing.peers import Contenders
from eval.tracing.scene import LIGHTS, camera, mitsuba_mesh, soft
from tron import seeds
from tron.cameras import mitsuba_sensor
from tron.estimation import FINAL
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.scene import GaussianScene
from tron.relighting import Relighter
from tron.runtime import lanes
from tron.shading.direct.irradiance import ORIGIN_OFFSET, irradiance
from tron.shading.environments.environment import EnvironmentLight
from tron.shading.guidance import render_guidance
from tron.shading.lighting import Lighting
from tron.tracing import GBuffer
from tron.tracing.gbuffer import trace_gbuffer
from tron.tracing.hierarchy.bvh import build_bvh
from tron.tracing.hierarchy.transmittance import Fans
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiled.tiles import build_tiles

TARGET = 0.5
"""The image of the gradient steps, a grey one: every pixel has something to learn."""
MANY = 64
"""Shadow rays a pixel of the irradiance pass."""

Found = tuple[Timed, list[Row]]


def case_of(contenders: Contenders, size: int) -> str:
    """Return the name in metrics, such as 50k_512."""
    return f"{format_count(len(contenders.scene))}_{size}"


def measure_shapes(contenders: Contenders, size: int, rounds: int) -> str:
    """Time the plugins for ``volprim_rf_basic``'s primitives and choose the faster."""
    sensor, integrator = peers.sensor(camera(size)), peers.load_integrator(peers.OUR_STOP)
    scenes = {shape: peers.primitives(contenders.scene, shape) for shape in peers.SHAPES}
    frames = {shape: lambda s=scene: peers.render(s, sensor, integrator) for shape, scene in scenes.items()}
    times = interleaved(frames, rounds)
    return min(times, key=lambda shape: times[shape].median)


def measure_camera(contenders: Contenders, size: int, rounds: int) -> Found:
    """Time a frame: ratios to the peers, million rays per second of all, and TRON's time of binning."""
    view, tracer = camera(size), contenders.tracer
    others = peers.camera_peers(contenders, view)
    contestants: dict[str, Callable[[], Any]] = {
        "tron": lambda: tracer.gbuffer(view),
        "binning": lambda: build_tiles(tracer.records, view).entries,
        **others,
    }
    timed = Timed("camera", case_of(contenders, size), interleaved(contestants, rounds))
    rows = [timed.over(f"primary.ratio_to_{name}", name, "tron") for name in others]
    for name in ("tron", *others):
        metric = "primary.mrays" if name == "tron" else f"primary.{name}_mrays"
        rows.append(timed.row(metric, size**2 / timed.times[name].median / 1e6, "Mrays/s", name))
    return timed, [
        *rows,
        timed.row("primary.binning_ms", 1e3 * timed.times["binning"].median, "ms", "binning"),
    ]


@dataclass
class Occluder:
    """Stand-in for the tracer in the irradiance pass; ``transmittance`` traces one ray per lane."""

    scene: GaussianScene
    transmittance: Callable[[mi.Point3f, mi.Vector3f, mi.Bool], mi.Float]

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        """Return one transmittance per direction."""
        return [
            self.transmittance(fans.origin, d, a) for d, a in zip(fans.directions, fans.active, strict=True)
        ]


def occluders(contenders: Contenders) -> dict[str, Occluder]:
    """Return occluders of the pass: nothing, or quads, opaque or not.

    The occluder ``nothing`` still reads the ray, so that the compiler does not remove it.
    """
    quads = contenders.quads

    def idle(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return dr.select(active & (origin.x + direction.x > 1e30), mi.Float(0), 1)

    def closest_hit(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        distance = peers.closest_hit(quads, origin, direction, active)
        return dr.select(active & dr.isfinite(distance), mi.Float(0), 1)

    def any_hit(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return dr.select(active & peers.any_hit(quads, origin, direction, active), mi.Float(0), 1)

    queries = {"idle": idle, "embree_closest_hit": closest_hit, "embree_any_hit": any_hit}
    return {name: Occluder(contenders.scene, query) for name, query in queries.items()}


def count_rays(scene: GaussianScene, gbuffer: GBuffer, light: EnvironmentLight, spp: int, seed: int) -> int:
    """Count the rays of the irradiance pass."""
    total = dr.zeros(mi.UInt32, 1)

    def counted(_origin: mi.Point3f, _direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        dr.scatter_add(total, mi.UInt32(1), mi.UInt32(0), active)
        return mi.Float(1)

    irradiance(Occluder(scene, counted), gbuffer, light, spp, seed)
    return int(total[0])


def measure_shadow(contenders: Contenders, size: int, rays: int, spp: int, seed: int, rounds: int) -> Found:
    """Time both sets of rays, and the builds; ``rays`` random rays, ``spp`` per pixel of the pass."""
    scene, tracer, quads = contenders.scene, contenders.tracer, contenders.quads
    gbuffer, light = tracer.gbuffer(camera(size)), EnvironmentLight(soft())
    ray = random_rays(gbuffer, scene.spacing, rays, seed)
    restarted = peers.RestartedShadows(scene, quads)
    in_the_way = {"tron": tracer, **occluders(contenders)}
    times = interleaved(
        {
            "random tron": lambda: tracer.transmittance(*ray),
            "random embree_restart": lambda: restarted.transmittance(*ray),
            "random embree_closest_hit": lambda: peers.closest_hit(quads, *ray),
            "random embree_any_hit": lambda: peers.any_hit(quads, *ray),
            **{
                f"irradiance {name}": lambda o=occluder: irradiance(o, gbuffer, light, spp, seed)
                for name, occluder in in_the_way.items()
            },
            "build": lambda: build_bvh(tracer.records).nodes,
            "embree_build": lambda: peers.quads(scene),
        },
        rounds,
    )
    timed = Timed("shadow", format_count(len(scene)), times)
    pass_rays = count_rays(scene, gbuffer, light, spp, seed)
    return timed, list(shadow_rows(timed, rays, pass_rays))


def shadow_rows(timed: Timed, rays: int, pass_rays: int) -> Iterator[Row]:
    """Yield rows of rays per second and ratios, for random rays and for the pass, then builds.

    TRON's build is in the ratios; the peers' builds are not. The time of the pass with no occluder is
    subtracted from both sides.
    """
    median = {name: times.median for name, times in timed.times.items()}
    for kind, count in (("random", rays), ("irradiance", pass_rays)):
        idle = median.get(f"{kind} idle", 0.0)
        names = [name.split()[1] for name in median if name.startswith(f"{kind} ")]
        seconds = {name: median[f"{kind} {name}"] - idle for name in names if name != "idle"}
        ours = seconds["tron"] + median["build"]
        for name, taken in seconds.items():
            metric = f"mrays_{kind}" if name == "tron" else f"{name}_mrays_{kind}"
            yield timed.row(f"shadow.{metric}", count / taken / 1e6, "Mrays/s")
        for name, taken in seconds.items():
            if name != "tron":
                suffix = "_random" if kind == "random" and name != "embree_restart" else ""
                yield timed.row(f"shadow.ratio_to_{name}{suffix}", taken / ours, "x")
    for name in ("build", "embree_build"):
        yield timed.row(f"bvh.{name}_ms", 1e3 * median[name], "ms")


def random_rays(gbuffer: GBuffer, spacing: float, rays: int, seed: int) -> tuple[mi.Point3f, mi.Vector3f]:
    """Return rays from ``rays`` random visible points in cosine-distributed directions, in pixel order.

    Only points of at least half opacity are drawn; origins are offset from the surface as in the irradiance
    pass.
    """
    rng = seeds.generator(seed, "tracing", "shadow rays", rays)
    buffers = gbuffer.numpy()
    visible = np.flatnonzero(buffers["opacity"].ravel() >= 0.5)
    chosen = np.sort(visible[rng.integers(0, len(visible), rays)])
    normals = buffers["normal"].reshape(-1, 3)[chosen].astype(np.float64)
    points = buffers["position"].reshape(-1, 3)[chosen] + ORIGIN_OFFSET * spacing * normals
    sphere = rng.normal(size=normals.shape)
    # A unit normal plus a uniform point of the unit sphere is cosine-distributed about the normal.
    directions = normals + 0.999999 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = lanes(mi.Point3f, points)
    direction = lanes(mi.Vector3f, directions)
    dr.eval(origin, direction)
    return origin, direction


def measure_gradient(contenders: Contenders, size: int, rounds: int) -> Found:
    """Time both steps in turns with equal stops, and return the cosine of the harmonics' gradients."""
    ours, peer = surfel_step(contenders, size), volprim_step(contenders, size)
    timed = Timed("gradient", case_of(contenders, size), interleaved({"tron": ours, "volprim": peer}, rounds))
    by_color = np.array(ours()["sh"]).reshape(len(contenders.scene), -1, 3)[:, 0].ravel()
    peer_color = np.array(peer()["surfels.sh_coeffs"]).ravel()
    cosine = by_color @ peer_color / max(np.linalg.norm(by_color) * np.linalg.norm(peer_color), 1e-30)
    return timed, [
        timed.over("gradient.ratio_to_volprim", "volprim", "tron"),
        timed.row("gradient.ms", 1e3 * timed.times["tron"].median, "ms"),
        timed.row("gradient.volprim_ms", 1e3 * timed.times["volprim"].median, "ms"),
        timed.row("gradient.cosine_with_volprim", float(cosine), "1"),
    ]


def surfel_step(contenders: Contenders, size: int) -> Callable[[], dict[str, Any]]:
    """Return a call that makes TRON's step from scratch: parameter -> gradient, evaluated by the caller."""
    view = camera(size)
    parameters = SurfelParameters.from_scene(contenders.scene)

    def step() -> dict[str, Any]:
        for name in PARAMETERS:
            value = dr.detach(getattr(parameters, name))
            dr.enable_grad(value)
            setattr(parameters, name, value)
        records = pack(parameters)
        image = trace_gbuffer(records, build_tiles(records.detached(), view), view).rgb
        dr.backward(dr.mean(dr.squared_norm(image - TARGET)) / 3)
        return {name: dr.grad(getattr(parameters, name)) for name in PARAMETERS}

    return step


def volprim_step(contenders: Contenders, size: int) -> Callable[[], dict[str, Any]]:
    """Return a call that makes the peer's step: parameter -> gradient, evaluated by the caller."""
    scene = contenders.primitives
    integrator, sensor = peers.load_integrator(peers.OUR_STOP), peers.sensor(camera(size))
    parameters = mi.traverse(scene)
    learned = [
        name
        for name in parameters.keys()  # noqa: SIM118 (not a dict)
        if name.startswith("surfels.") and name.rpartition(".")[2] in ("data", "opacities", "sh_coeffs")
    ]

    def step() -> dict[str, Any]:
        for name in learned:
            dr.disable_grad(parameters[name])
            dr.enable_grad(parameters[name])
        parameters.update()
        image = mi.render(scene, parameters, sensor=sensor, integrator=integrator, spp=1)
        dr.backward(dr.mean(dr.square(image - TARGET), axis=None))
        return {name: dr.grad(parameters[name]) for name in learned}

    return step


def measure_direct(
    contenders: Contenders, size: int, light: str, seed: int, rounds: int
) -> tuple[Timed, float, dict[str, np.ndarray], float]:
    """Time the irradiance pass on surfels and Mitsuba's ``direct`` on the mesh: equal rays, equal light.

    Mitsuba's 64 rays are tried in both ways it offers: all from one camera ray, and two from each of 32.

    Returns:
        Times; TRON's time, its hierarchy's build and its camera rays included, over Mitsuba's faster time;
        linear pictures (H, W, 3) of both; their exposure.
    """
    view, environment = camera(size), LIGHTS[light]()
    prepared, tracer = EnvironmentLight(environment), contenders.tracer
    gbuffer = tracer.gbuffer(view)
    scene = mi.load_dict({"type": "scene", **mitsuba_mesh(), "light": environment.to_mitsuba()})
    half = MANY // 2
    contestants: dict[str, Any] = {
        "tron": lambda: irradiance(tracer, gbuffer, prepared, MANY, seed),
        "build": lambda: build_bvh(tracer.records).nodes,
        "gbuffer": lambda: tracer.gbuffer(view),
    }
    for name, (spp, samples) in {"direct at once": (1, half), "direct by camera rays": (half, 1)}.items():
        integrator = mi.load_dict(
            {"type": "direct", "emitter_samples": samples, "bsdf_samples": samples, "hide_emitters": True}
        )
        sensor = mi.load_dict(mitsuba_sensor(view, spp=spp))
        contestants[name] = lambda i=integrator, s=sensor, n=spp: mi.render(
            scene, sensor=s, integrator=i, spp=n
        )
    times = interleaved(contestants, rounds)
    images = {
        "TRON, 64 rays": gbuffer.image(contestants["tron"]()[0]),
        "Mitsuba, mesh": np.array(contestants["direct by camera rays"]()),
    }
    direct = min(t.median for name, t in times.items() if name.startswith("direct"))
    ratio = sum(times[name].median for name in ("tron", "build", "gbuffer")) / direct
    return (
        Timed(f"irradiance {light}", case_of(contenders, size), times),
        ratio,
        images,
        environment.exposure(),
    )


def measure_bounce(contenders: Contenders, size: int, rounds: int) -> Found:
    """Time transport, bake, and a frame of 64 rays per pixel with and without the bake, in turns.

    The frame with the bake is rendered by the ``Relighter``, and by hand from its transport and bake.
    """
    view, lighting = camera(size), Lighting(soft())
    untraced = Relighter(contenders.scene, proxy="never")
    light = copy(untraced).under(lighting)
    tracer, baked = untraced.tracer(view), light.bounced
    contestants = {
        "transport": lambda: copy(untraced).transport.rays.met,
        "bake": lambda: light.relighter.under(lighting).bounced,
        "frame": lambda: render_guidance(tracer, view, lighting, FINAL),
        "lit frame": lambda: render_guidance(tracer, view, lighting, FINAL, bounce=baked),
        "relighter": lambda: light.render(view),
    }
    timed = Timed("bounce", case_of(contenders, size), interleaved(contestants, rounds))
    seconds = [
        timed.row(f"bounce.{name}_seconds", timed.times[name].median, "s", name)
        for name in ("transport", "bake", "frame")
    ]
    return timed, [
        timed.over("bounce.seconds_ratio_to_frame", "bake", "frame"),
        timed.over("bounce.lit_frame_ratio", "lit frame", "frame"),
        timed.over("relighter.overhead", "relighter", "lit frame"),
        *seconds,
    ]

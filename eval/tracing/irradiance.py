"""The irradiance pass: its time against Mitsuba's ``direct``, and its noise at equal rays and at equal time.

Noise is measured on the buffer that the neural renderer is given, against the same buffer with thousands of
rays per pixel, as a share of the light on an unshadowed upward plane. Plain independent sampling, the
yardstick, is written again here: the same estimator with random numbers that know nothing of one another.

Errors may be noise, never blocks. For pairs of pixels at one offset, errors correlate as much within an
aligned block as across its border, unless pixels of a block share something: that excess is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.peers.contenders import Contenders
from eval.peers.scene import camera, mitsuba_mesh
from eval.peers.timing import Rounds, interleaved
from eval.tracing.lights import LIGHTS
from eval.tracing.measured import DirectTimes, LitImages, Noise
from tron import seeds
from tron.cameras import mitsuba_sensor
from tron.color import luminance
from tron.shading import EnvironmentLight, Estimation, Lighting, irradiance, render_guidance
from tron.shading.guidance import Arriving, Guidance, shade
from tron.shading.irradiance import ORIGIN_OFFSET
from tron.shading.visibility import reaching_share
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.bvh import build_bvh

FEW, MANY = 2, 64
FAN = 4
REFERENCE_SEED, TRIALS = 1_000_003, 8


def measure_direct(contenders: Contenders, size: int, light: str, seed: int, rounds: Rounds) -> DirectTimes:
    """Time the pass on the surfels and Mitsuba on the mesh: as many shadow rays, the same camera and light.

    Mitsuba's 64 rays are tried in both ways it offers: all from one camera ray, and two from each of 32.
    """
    view, environment = camera(size), LIGHTS[light]()
    prepared = EnvironmentLight(environment)
    tracer = contenders.tracer
    gbuffer = tracer.gbuffer(view)
    scene = mi.load_dict({"type": "scene", **mitsuba_mesh(), "light": environment.to_mitsuba()})
    half = MANY // 2
    ways = {"direct at once": (1, half), "direct by camera rays": (half, 1)}
    contestants: dict[str, Any] = {
        "tron": lambda: irradiance(tracer, gbuffer, prepared, MANY, seed),
        "build": lambda: build_bvh(tracer.records).nodes,
        "gbuffer": lambda: tracer.gbuffer(view),
    }
    for name, (spp, samples) in ways.items():
        integrator = mi.load_dict(
            {"type": "direct", "emitter_samples": samples, "bsdf_samples": samples, "hide_emitters": True}
        )
        sensor = mi.load_dict(mitsuba_sensor(view, spp=spp))
        contestants[name] = lambda i=integrator, s=sensor, n=spp: mi.render(
            scene, sensor=s, integrator=i, spp=n
        )
    times = interleaved(contestants, rounds)
    shadowed, _ = contestants["tron"]()
    images = {
        "tron": gbuffer.image(shadowed),
        "direct": np.array(contestants["direct by camera rays"]()),
    }
    lit = LitImages(light, environment.exposure(), images)
    return DirectTimes(len(contenders.scene), size, times, lit)


class LitView:
    """The benchmark's view of the surfels under one light, beside a rendering of many rays per pixel.

    Attributes:
        tracer: of the surfels.
        lighting: the prepared light.
        truth: the rendering of many rays.
        surface: (H, W) bool, pixels with a surface.
    """

    def __init__(self, contenders: Contenders, size: int, light: str, reference_spp: int, seed: int) -> None:
        environment = LIGHTS[light]()
        self.tracer, self.lighting = contenders.tracer, Lighting(environment)
        self._light, self._exposure = light, environment.exposure()
        self._plane = float(luminance(environment.unoccluded_upward()))
        self._view, self._seed = camera(size), seed
        self.truth = self._render(Estimation(rays=reference_spp), REFERENCE_SEED)
        self.surface = self.truth.mask > 0

    def _render(self, estimation: Estimation, seed: int) -> Guidance:
        return render_guidance(self.tracer, self._view, self.lighting, estimation, seed)

    def trials(self, count: int, rays: int, filtered: bool = False) -> list[np.ndarray]:
        """Irradiance of few rays, (H, W, 3) each."""
        estimation = Estimation(rays=rays, filtered=filtered)
        return [self._render(estimation, self._seed + k).irradiance for k in range(count)]

    def rmse(self, trials: Sequence[np.ndarray]) -> float:
        """Error of trials as a share of an upward plane's light."""
        return relative_rmse(trials, self.truth.irradiance, self.surface, self._plane)

    def images(self, trials: Mapping[str, Sequence[np.ndarray]]) -> LitImages:
        """The first trial of each way, and the reference."""
        firsts = {way: images[0] for way, images in trials.items()}
        return LitImages(self._light, self._exposure, {"reference": self.truth.irradiance, **firsts})


def measure_noise(contenders: Contenders, size: int, light: str, reference_spp: int, seed: int) -> Noise:
    """Errors of TRON's and of independent sampling at 2 and 64 rays, and at the time of TRON's 64."""
    lit = LitView(contenders, size, light, reference_spp, seed)
    tracer, lighting, gbuffer = lit.tracer, lit.lighting, lit.tracer.gbuffer(camera(size))

    def independent(rays: int) -> list[np.ndarray]:
        images = []
        for k in range(TRIALS):
            sums = independent_irradiance(tracer, gbuffer, lighting.light, rays, seed + k)
            estimation = Estimation(rays=rays)
            share = reaching_share(*sums, gbuffer, lighting, tracer.scene.spacing, estimation)
            images.append(shade(gbuffer, Arriving(share), lighting).irradiance)
        return images

    times = interleaved(
        {
            "tron": lambda: irradiance(tracer, gbuffer, lighting.light, MANY, seed),
            "independent": lambda: independent_irradiance(tracer, gbuffer, lighting.light, MANY, seed),
        },
        Rounds(3),
    )
    equal = max(2, 2 * round(MANY / 2 * times["tron"].over(times["independent"])))
    trials = {
        "rmse_2spp": lit.trials(TRIALS, FEW),
        "independent_rmse_2spp": independent(FEW),
        "rmse_2spp_denoised": lit.trials(TRIALS, FEW, filtered=True),
        "rmse_64spp": lit.trials(TRIALS, MANY),
        "independent_rmse_64spp": independent(MANY),
        "independent_rmse_equal_time": independent(equal),
    }
    blocks = {}
    for side in (4, 8):
        for whose in ("", "independent_"):
            errors = luminance(np.stack(trials[f"{whose}rmse_64spp"]) - lit.truth.irradiance)
            name = f"{whose}block_correlation_{side}x{side}"
            blocks[name] = block_correlation(errors, lit.surface, side)
    rmse = {name: lit.rmse(images) for name, images in trials.items()}
    return Noise(lit.images(trials), TRIALS, rmse, blocks, equal)


def relative_rmse(
    images: Sequence[np.ndarray], truth: np.ndarray, surface: np.ndarray, plane: float
) -> float:
    """Root mean square over trials, pixels with a surface and channels, over an upward plane's light."""
    squares = [((image - truth)[surface].astype(np.float64) ** 2).mean() for image in images]
    return float(np.sqrt(np.mean(squares)) / plane)


def block_correlation(errors: np.ndarray, surface: np.ndarray, side: int) -> float:
    """Excess correlation of errors inside aligned ``side`` x ``side`` blocks over that across their borders.

    Errors are brought to unit size in each pixel first, over the trials, so that no bright penumbra decides.
    Pairs lie one to ``side`` - 1 pixels apart along a row or a column; each offset's mean product within
    blocks is compared with its mean product across borders, and the offsets are averaged by their pairs.
    Noise gives 0, blue noise too (it is alike on both sides of a border), a value shared by a block 1. Below
    0, the pixels of a block make up for one another.

    Args:
        errors: (K, H, W) of K trials.
        surface: (H, W) bool, pixels that count.
    """
    size = np.sqrt((errors.astype(np.float64) ** 2).mean(0))
    counts = surface & (size > 1e-6 * max(float(size.max()), 1e-30))
    unit = np.where(counts, errors / np.where(counts, size, 1), 0)
    total = weight = 0.0
    for values, mask in ((unit, counts), (unit.transpose(0, 2, 1), counts.T)):
        block = np.arange(mask.shape[1]) // side
        for offset in range(1, side):
            product = (values[:, :, :-offset] * values[:, :, offset:]).mean(0)
            both = mask[:, :-offset] & mask[:, offset:]
            same = both & (block[:-offset] == block[offset:])[None]
            across = both & ~same
            pairs = min(same.sum(), across.sum())
            if pairs:
                total += pairs * (product[same].mean() - product[across].mean())
                weight += pairs
    return float(total / weight) if weight else 0.0


def independent_irradiance(
    tracer: SurfelTracer, gbuffer: GBuffer, light: EnvironmentLight, spp: int, seed: int
) -> tuple[mi.Color3f, mi.Color3f]:
    """Shadowed and unshadowed irradiance / pi by the estimator of :mod:`tron.shading.irradiance`, plainly.

    Every ray has random numbers of its own (PCG32); half are cosine-distributed, half follow the light.
    Rays go in fans, as in the pass itself, so that only the numbers differ.
    """
    frame = mi.Frame3f(gbuffer.normal)
    origin = gbuffer.position + frame.n * dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
    surface = gbuffer.opacity > 0
    stream = dr.opaque(mi.UInt64, seeds.integer(seed, "independent irradiance", bits=31))
    random = mi.PCG32(size=dr.width(surface), initstate=stream)
    shadowed, unshadowed = (dr.zeros(mi.Color3f, dr.width(surface)) for _ in range(2))
    dr.make_opaque(shadowed, unshadowed)
    dr.eval(frame, origin, surface, random)
    half, fan = spp // 2, FAN if spp % (2 * FAN) == 0 else 1
    for first in range(0, spp, fan):
        follows_light = dr.opaque(mi.Bool, first >= half)
        directions, values, active = [], [], []
        for _ in range(fan):
            u = mi.Point2f(random.next_float32(), random.next_float32())
            around_normal = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
            direction = dr.select(follows_light, light.sample(u)[0], around_normal)
            cosine_pdf = dr.dot(frame.n, direction) * dr.inv_pi
            radiance = light.radiance(direction)
            counts = surface & (cosine_pdf > 0) & (dr.max(radiance) > 0)
            weight = cosine_pdf / (cosine_pdf + light.pdf(direction))
            directions.append(direction)
            active.append(counts)
            values.append(dr.select(counts, radiance * weight, 0))
        visible = tracer.transmittances(origin, directions, active)
        unshadowed += sum(values)
        shadowed += sum(value * share for value, share in zip(values, visible, strict=True))
        dr.eval(shadowed, unshadowed, random)
    scale = dr.opaque(mi.Float, 1 / half)
    shadowed, unshadowed = shadowed * scale, unshadowed * scale
    dr.eval(shadowed, unshadowed)
    return shadowed, unshadowed

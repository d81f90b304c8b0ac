"""Materials of learnt surfels, of a scan or of photos, in any number of layers.

Light treats learnt surfels as fog: their normals and shadows mean little. So light and materials are fitted
on their one-layer proxy (:mod:`tron.relighting.proxy`), from the photos or from a film of the scan, by the
joint fit (:mod:`tron.reconstruction.materials.joint_fit`). The fitted shading is then divided out of each
surfel's own colour, which keeps all of its detail. For proxy surfel p and the surfels i nearest to it

    shade_p = shown_p / max(base_p, 0.01), a geometric mean over neighbours with similar normals
    base_i  = own_i / shade_p, within base_p / 8 and 8 base_p
    roughness_i, metallic_i = those of p

Pictures alone do not tell bright paint in dim light from dark paint in bright light, nor coloured paint from
coloured light. A camera's white balance and exposure do. So mean irradiance over the seen surfels is held
grey and at the metered brightness (:func:`tron.reconstruction.materials.joint_fit.metered_light`), before
base color is clamped. Assuming "the brightest surfaces are at 0.8" fails for a man in black leather.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from tron.captures import Capture
from tron.captures.view import FLOOR, ToneCurve, decoded, encoded
from tron.estimation import Estimation
from tron.gaussians.harmonics import dc_to_rgb
from tron.gaussians.neighbours import alike_neighbours
from tron.gaussians.scene import GaussianScene
from tron.metrics import capped_psnr
from tron.reconstruction.light.fit_pairs import LightSettings, TooFewSeen
from tron.reconstruction.materials.joint_fit import JointFit, JointSettings, fit_jointly
from tron.reconstruction.progress import Track, untracked
from tron.relighting import Relighter
from tron.relighting.proxy import Proxy, make_proxy
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

_SCALE = 1.0
"""Weight of base color's brightness prior; photos use 0.05, at which it reached 1.36 and was clipped."""
_GREY = 0.5
"""Weight of the prior for grey light; photos use 0.05, at which a golden guitar turned green in red light."""
_DARKEST = 0.01
_SHADED, _ALIKE, _MOST = 1.0, 0.8, 100
"""Deviation in spacings of the Gaussian that shade is averaged by, least cosine, and how many surfels at
most: 0.0 to 0.16 dB of relit pictures on four development captures, photographs of seeds 4242, 90210 and
77041."""
_APART = 8.0
"""Largest factor between the base colors of a surfel and of its proxy surfel."""
_COMPARED, _RAYS, _SOLID = 6, 8, 0.99


@dataclass(frozen=True, eq=False)
class Carried:
    """A scan with materials, and the light that it was captured in.

    Attributes:
        scene: every surfel of the scan with its own radiance, and with materials.
        proxy: its one-layer proxy for light, with the materials of the fit.
        fit: of the proxy.
        explained: PSNR in dB of the scan rendered under the found light against its own look.
    """

    scene: GaussianScene
    proxy: Proxy
    fit: JointFit
    explained: float

    def said(self) -> dict[str, Any]:
        """Plain values for a report."""
        return {**self.fit.said(), "explained_psnr": round(self.explained, 2)}


def carry_materials(
    capture: Capture, settings: JointSettings, seed: int, track: Track = untracked
) -> Carried | None:
    """Find a scan's materials and the light of its capture; None, with a log line, if it shows no surface.

    Args:
        capture: film of its ``scan``; the scan's harmonics are display values.
        settings: of the joint fit. Its exposure and balance settings are ignored: a film has one exposure.
        seed: root of the random numbers.
        track: wraps long loops.

    Raises:
        TronError: a loss is not finite.
    """
    scan = capture.scan
    assert scan is not None
    light = LightSettings(**settings.light.model_dump() | {"scale": _SCALE, "grey": _GREY})
    held = settings.model_copy(update={"light": light, "same_exposure": True, "neutral": True})
    found = by_proxy(capture, scan, held, seed, track)
    if found is None:
        log.warning("views of the scan agree on no surface, so that its materials cannot be told")
        return None
    scene, proxy, fit = found
    explained = _explained(scene, proxy, fit, capture, settings.tone_curve or capture.tone_curve, seed)
    log.info("%s; under it the scan looks as it did to %.1f dB", described(fit, capture.up), explained)
    return Carried(scene, proxy, fit, explained)


def by_proxy(
    capture: Capture, scene: GaussianScene, settings: JointSettings, seed: int, track: Track = untracked
) -> tuple[GaussianScene, Proxy, JointFit] | None:
    """Fit light and materials on the proxy of learnt surfels, and carry the materials to the surfels.

    None if the capture's views agree on no surface, or show too few of its surfels.

    Args:
        capture: its training views are fitted.
        scene: surfels learnt from the views, or filmed by them; their mean colours are display values.
        settings: of the joint fit.
        seed: root of the random numbers.
        track: wraps long loops.

    Raises:
        TronError: a loss is not finite.
    """
    cameras = [view.camera for view in capture.train_views]
    proxy = make_proxy(SurfelTracer(scene), cameras, lambda n: track(n, "filming a proxy for light"))
    if proxy is None:
        return None
    try:
        fit = fit_jointly(capture, proxy.surfels, settings, seed, track)
    except TooFewSeen:
        log.info("photos show too little of the proxy")
        return None
    carried = carry(scene, fit, settings.tone_curve or capture.tone_curve)
    return carried, replace(proxy, surfels=fit.scene), fit


def carry(scan: GaussianScene, fit: JointFit, curve: ToneCurve) -> GaussianScene:
    """Carry the materials of a proxy's fit to a scan or to surfels learnt from photos (module docstring).

    Args:
        scan: its mean colours are display values.
        fit: of the proxy's surfels.
        curve: tone curve of these display values.
    """
    proxy = fit.scene
    near = np.asarray(KDTree(proxy.means).query(scan.means)[1])
    shade = np.log(np.maximum(fit.shown, FLOOR) / np.maximum(proxy.base_color, _DARKEST))
    numbers, weights = alike_neighbours(proxy, _MOST, _SHADED, _ALIKE)
    shade = np.exp(np.einsum("mk,mkc->mc", weights, shade[numbers]))
    own = decoded(np.clip(dc_to_rgb(scan.sh[:, 0]), 0, 1).astype(np.float32), curve)
    usual = np.maximum(proxy.base_color, _DARKEST)[near]
    base = np.clip(own / shade[near], usual / _APART, usual * _APART)
    return replace(
        scan,
        base_color=np.clip(base, 0, 1),
        roughness=proxy.roughness[near],
        metallic=proxy.metallic[near],
        materials_guessed=False,
    )


def _explained(
    scene: GaussianScene, proxy: Proxy, fit: JointFit, capture: Capture, curve: ToneCurve, seed: int
) -> float:
    """Mean PSNR, display values, of some views under the found light against the film, where it is opaque.

    Held-out views are used if there are any.
    """
    light = Relighter(scene, Estimation(rays=_RAYS, filtered=True), seed, proxy=proxy).under(fit.environment)
    views, found = capture.test_views or capture.train_views, []
    for number in np.unique(np.linspace(0, len(views) - 1, _COMPARED).astype(int)):
        view = views[number]
        solid = view.read("mask") > _SOLID
        if solid.any():
            relit = encoded(light.render(view.camera, seed).lit * np.float32(capture.exposure), curve)
            found.append(capped_psnr(relit, view.read(), solid))
    return float(np.mean(found)) if found else 0.0


def described(fit: JointFit, up: np.ndarray) -> str:
    """The light that was found, in words; ``up`` (3,) unit, world."""
    found = fit.environment.unoccluded(up) * fit.balance
    red, green, blue = found / found.mean()
    warm = "neutral" if abs(np.log(red / blue)) < 0.1 else "warm" if red > blue else "cool"
    tint = f"{warm} before it was balanced (R, G, B {red:.2f}, {green:.2f}, {blue:.2f})"
    if fit.sun is None:
        return f"the light that was found has no sun, and was {tint}"
    height = np.degrees(np.arcsin(np.clip(fit.sun.direction @ up, -1, 1)))
    return f"the light that was found has a sun {height:.0f} degrees high, and was {tint}"

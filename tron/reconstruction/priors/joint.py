"""`prior=joint`: light and materials are what explains the photos on the surfels; nothing else is asked."""

from __future__ import annotations

import logging

from tron.captures import Capture
from tron.gaussians.fields import MATERIALS
from tron.reconstruction.light.fit_pairs import TooFewSeen
from tron.reconstruction.materials.carried import Carried, by_proxy, carry_materials
from tron.reconstruction.materials.joint_fit import JointSettings, fit_jointly
from tron.reconstruction.priors.prior import Light, Materials, Prior, Surfels
from tron.reconstruction.progress import Track

log = logging.getLogger(__name__)


class Joint(JointSettings, Prior):
    """Prior of nothing but photos: see :mod:`tron.reconstruction.materials.joint_fit`."""

    def check(self, capture: Capture) -> None:
        """Photos are enough."""

    def carry(self, capture: Capture, seed: int, track: Track) -> Carried | None:
        """See :func:`carry_materials`."""
        return carry_materials(capture, self, seed, track, judged=True)

    def find_materials(self, surfels: Surfels) -> Materials:
        """Find light and materials together, on a proxy of the surfels; where there is none, on themselves.

        Neither where photos show too few surfels: the log says so.
        """
        given = (surfels.capture, surfels.scene, self, surfels.seed, surfels.track)
        if (found := by_proxy(*given)) is not None:
            scene, proxy, fit = found
            return Materials(scene, MATERIALS, Light(fit.environment, fit.said()), fit.colors.gain, proxy)
        try:
            fit = fit_jointly(*given)
        except TooFewSeen as error:  # surfaces were not found: that is no reason to lose what was
            log.warning("%s: base color is what the photos show, and there is no light", error)
            return Materials(surfels.scene)
        return Materials(fit.scene, MATERIALS, Light(fit.environment, fit.said()), fit.colors.gain)

"""Surfels of a capture under its own light and others: the ways that light bounces are traced once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from datagen.captured_reconstruction import Found
from datagen.plan import Work
from datagen.settings import Settings
from datagen.spool import Frame, stored_guidance
from tron.cameras import Camera
from tron.estimation import Estimation
from tron.seeds import integer
from tron.shading.bounce import BouncedLight, BounceTransport
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.shading.surface_maps import surface_maps
from tron.tracing import SurfelTracer


@dataclass(frozen=True)
class LitSurfels:
    """Surfels of a capture under one light.

    Attributes:
        root: seed of the dataset.
        streams: words that name the light's random streams.
    """

    tracer: SurfelTracer
    lighting: Lighting
    bounce: BouncedLight | None
    estimation: Estimation
    root: int
    streams: tuple[int | str, ...]

    def view(self, camera: Camera, name: str, background: Sequence[float] | None = None) -> Guidance:
        """Guidance of one view, by its name; ``background`` as of ``render_guidance``."""
        seed = integer(self.root, *self.streams, "frame", name, "guidance")
        return render_guidance(
            self.tracer, camera, self.lighting, self.estimation, seed, background, self.bounce
        )

    def frame(self, guidance: Guidance, camera: Camera) -> Frame:
        """Members of one view that surfels give, with the guidance that :meth:`view` gave of it."""
        return stored_guidance(guidance) | surface_maps(self.tracer, camera)


class CapturedSurfels:
    """Surfels of a capture, ready to be lit.

    Args:
        item, settings: the capture and its recipe.
        found: its surfels.
    """

    def __init__(self, item: Work, settings: Settings, found: Found) -> None:
        self._root, self._streams = settings.seed, ("captured", item.capture)
        self._tracer = SurfelTracer(found.scene)
        self._estimation = settings.estimation(item.split)
        self._transport: BounceTransport | None = None
        if self._estimation.bounces:
            self._transport = BounceTransport.trace(
                self._tracer.sided(self._estimation.two_sided),
                seed=integer(self._root, *self._streams, "bounce"),
            )

    def under(self, environment: EnvironmentMap, *light: int | str) -> LitSurfels:
        """The surfels under a light, whose words name its random streams: none for the capture's own."""
        streams, lighting, bounce = (*self._streams, *light), Lighting(environment), None
        if self._transport is not None:
            seed = integer(self._root, *streams, "light", "bounce")
            bounce = self._transport.bake(lighting, self._estimation, seed=seed)
        return LitSurfels(self._tracer, lighting, bounce, self._estimation, self._root, streams)

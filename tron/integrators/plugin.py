"""The side of an integrator that Mitsuba sees: rays of a sensor, channels of a film, parameters, gradients.

What rays show is decided by an :class:`Appearance`, one a plugin. Mitsuba's base classes differ between
variants, so the class that Mitsuba knows is made for the active one, around an appearance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from tron.integrators.surfels import Surfels


@dataclass
class Shown:
    """Colours along rays, one lane a ray.

    Attributes:
        color: the main channels.
        alpha: opacity.
        extra: a value for each of ``Appearance.channels``.
    """

    color: mi.Color3f
    alpha: mi.Float
    extra: list[mi.Float]


class Appearance(Protocol):
    """View of a plugin on its surfels.

    Attributes:
        channels: names of the channels beside color and alpha, as Mitsuba's ``aov`` integrator names its own.
    """

    surfels: Surfels
    channels: list[str]

    def show(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, width: int, seed: int) -> Shown:
        """Colours along rays; ``width`` of them make a row of an image, ``seed`` roots random numbers."""
        ...


def plugin_class(name: str, make: Callable[[mi.Properties], Appearance]) -> type:
    """The integrator ``name`` for the active variant, around the appearance that ``make`` reads."""
    from mitsuba.python.ad.integrators.common import ADIntegrator as Steps

    class Plugin(mi.SamplingIntegrator):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            self.appearance = make(properties)

        def render(
            self,
            scene: mi.Scene,
            sensor: mi.Sensor | int = 0,
            seed: mi.UInt32 | int = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> mi.TensorXf:
            """Mitsuba's contract; attached to the parameters, so its default gradients are those of this."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            film = sensor.film()
            sampler, spp = Steps.prepare(self, sensor, seed, spp, self.aov_names())
            ray, weight, position = Steps.sample_rays(self, scene, sensor, sampler)
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            width = (film.crop_size().x + border) * spp
            root = seed if isinstance(seed, int) else int(seed[0])
            # Mitsuba evaluates loops step by step for gradients by AD; the tracer replays hit lists instead.
            with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
                shown = self.appearance.show(scene, ray, mi.Bool(True), width, root)
            block = film.create_block()
            block.set_coalesce(block.coalesce() and spp >= 4)
            Steps._splat_to_block(
                block, film, position, shown.color * weight, 1.0, shown.alpha, shown.extra, ray.wavelengths
            )
            film.put_block(block)
            image = film.develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(image)
            return image

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.Ray3f,
            medium: mi.Medium | None = None,
            active: mi.Bool | bool = True,
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
            """Mitsuba's contract for single rays. The seed comes from ``sampler``."""
            del medium
            width = dr.width(ray)
            seed = int(sampler.next_1d()[0] * 2**24)
            shown = self.appearance.show(scene, ray, mi.Bool(active), width, seed)
            return shown.color, shown.alpha > 0, shown.extra

        def aov_names(self) -> list[str]:
            return self.appearance.channels

        def traverse(self, callback: Any) -> None:
            self.appearance.surfels.traverse(callback)

        def parameters_changed(self, keys: Any = ()) -> None:
            del keys
            self.appearance.surfels.parameters_changed()

        def to_string(self) -> str:
            return f"{name}[surfels={len(self.appearance.surfels.scene)}, channels={self.aov_names()}]"

    Plugin.__name__ = Plugin.__qualname__ = name
    return Plugin

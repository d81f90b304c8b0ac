"""Mitsuba's interface of an integrator: rays of a sensor, channels of a film, parameters, gradients.

The :class:`Appearance` of a plugin decides the colours along rays. Mitsuba's base classes differ between
variants, so the integrator class is made for the active variant, around an appearance.

``mi.load_dict`` accepts only Mitsuba's own objects, so scenes from memory are wrapped in one
(:func:`embed`). The parameters of :class:`tron.tracing.parameters.SurfelParameters` are exposed to
``mi.traverse`` one by one: flat arrays, updated and differentiated like those of any Mitsuba plugin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.scene import GaussianScene
from tron.tracing import Surface, SurfelTracer
from tron.tracing.parameters import SurfelParameters

MAX_SH_DEGREE = 3


@dataclass
class Shown:
    """Colours along rays, one lane per ray.

    Attributes:
        color: the main channels.
        alpha: opacity.
        extra: a value for each of ``Appearance.channels``.
    """

    color: mi.Color3f
    alpha: mi.Float
    extra: list[mi.Float]


class Appearance(Protocol):
    """How a plugin shows its surfels.

    Attributes:
        channels: names of the channels beside color and alpha, in the style of Mitsuba's ``aov`` integrator.
    """

    surfels: Surfels
    channels: list[str]

    def show(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, width: int, seed: int) -> Shown:
        """Colours along rays; ``width`` rays make a row of an image, ``seed`` roots random numbers."""
        ...


def plugin_class(name: str, make: Callable[[mi.Properties], Appearance]) -> type:
    """The integrator class ``name`` for the active variant; ``make`` reads its appearance from properties."""
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
            """Mitsuba's contract; attached to the parameters, so its default gradients are right."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            film = sensor.film()
            sampler, spp = Steps.prepare(self, sensor, seed, spp, self.aov_names())
            ray, weight, position = Steps.sample_rays(self, scene, sensor, sampler)
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            width = (film.crop_size().x + border) * spp
            root = seed if isinstance(seed, int) else int(seed[0])
            # For AD Mitsuba would evaluate loops step by step; the tracer replays hit lists instead.
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


def embed(value: Any) -> mi.Object:
    """Wrap a GaussianScene, an EnvironmentMap or a list for ``mi.load_dict``; the variant must be set."""
    return _carrier(mi.variant())(value)


def unwrap(properties: mi.Properties, name: str, kind: type, plugin: str) -> Any:
    """The object that :func:`embed` put into property ``name``.

    Raises:
        TronError: the property holds something else.
    """
    carried = getattr(properties[name], "carried", None)
    if not isinstance(carried, kind):
        raise TronError(
            f"property {name!r} of {plugin} holds no {kind.__name__}",
            mend=f"give tron.integrators.embed(value) of a {kind.__name__}",
        )
    return carried


@cache
def _carrier(variant: str) -> type:
    """The wrapper class; Mitsuba's classes differ between variants, so each has its own."""

    class Carrier(mi.Object):
        def __init__(self, carried: Any) -> None:
            super().__init__()
            self.carried = carried

    Carrier.__qualname__ = f"Carrier[{variant}]"
    return Carrier


class Surfels:
    """The surfels that a plugin renders, and their parameters.

    Args:
        properties: of the plugin; ``filename`` (a PLY) or ``surfels`` (of :func:`embed`).
        plugin: its name, for messages.

    Raises:
        TronError: neither property is given, or both; a file that is missing or no scene.
    """

    def __init__(self, properties: mi.Properties, plugin: str) -> None:
        sources = [name for name in ("filename", "surfels") if name in properties]
        if len(sources) != 1:
            raise TronError(
                f"{plugin} needs its surfels once, not {len(sources)} times",
                mend="give `filename`, a PLY, or `surfels`, of tron.integrators.embed(scene)",
            )
        if sources == ["filename"]:
            self.scene = GaussianScene.load(str(properties["filename"]))
        else:
            self.scene = unwrap(properties, "surfels", GaussianScene, plugin).validate()
        self.parameters = SurfelParameters.from_scene(self.scene)
        self.tracer = SurfelTracer(self.scene, parameters=self.parameters)

    def traverse(self, callback: Any) -> None:
        """Expose the parameters, all differentiable."""
        for name in PARAMETERS:
            callback.put(name, getattr(self.parameters, name), mi.ParamFlags.Differentiable)

    def parameters_changed(self) -> None:
        """Apply new values of the parameters: shapes stay, surfels may have moved."""
        # Harmonics of any degree may have been set, or are about to be learnt.
        self.parameters.sh_degree = MAX_SH_DEGREE
        self.tracer.update()

    def state(self, *names: str) -> list[Held]:
        """A value that is equal for equal states of these parameters."""
        return [Held(getattr(self.parameters, name)) for name in names]

    def trace(
        self,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool,
        values: Sequence[mi.Float] = (),
    ) -> Surface:
        """Surfaces along rays, attached to the parameters where their gradients are wanted.

        ``values`` as in :meth:`tron.tracing.SurfelTracer.trace`.
        """
        if dr.grad_enabled(self.parameters.sh):
            self.parameters.sh_degree = MAX_SH_DEGREE
        return self.tracer.trace(origin, direction, active, values)


class Held:
    """A parameter that compares equal while its variables are the same; held, so that no index is reused."""

    def __init__(self, value: Any) -> None:
        self._value = dr.detach(value) if dr.is_array_v(value) else value
        self._identity = mi.util._jit_id_hash(value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Held) and self._identity == other._identity

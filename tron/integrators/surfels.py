"""Surfels within a Mitsuba plugin: where they come from, and their parameters under Mitsuba's names.

``mi.load_dict`` takes no Python object but Mitsuba's own, so scenes from memory travel inside one
(:func:`embed`). The parameters are those of :class:`tron.tracing.parameters.SurfelParameters`, exposed to
``mi.traverse`` one by one: flat arrays, updated and differentiated as those of any Mitsuba plugin.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.scene import GaussianScene
from tron.integrators.held import Held
from tron.tracing import Surface, SurfelTracer
from tron.tracing.parameters import SurfelParameters

MAX_SH_DEGREE = 3


def embed(value: Any) -> mi.Object:
    """A GaussianScene, an EnvironmentMap or a list of them for ``mi.load_dict``; the variant must be set."""
    return _carrier(mi.variant())(value)


def unwrap(properties: mi.Properties, name: str, kind: type, plugin: str) -> Any:
    """Content that :func:`embed` put into property ``name``.

    Raises:
        TronError: something else is there.
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
    """Mitsuba's classes differ between variants, so there is one subclass for each."""

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
        """Take new values of the parameters: shapes stay, surfels may have moved."""
        # Harmonics of any degree may have come, or be about to be learnt.
        self.parameters.sh_degree = MAX_SH_DEGREE
        self.tracer.update()

    def state(self, *names: str) -> list[Held]:
        """Equal for equal states of these parameters."""
        return [Held(getattr(self.parameters, name)) for name in names]

    def trace(
        self,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool,
        values: Sequence[mi.Float] = (),
    ) -> Surface:
        """Surfaces along rays, attached to the parameters where their gradients are wanted.

        ``values`` as of :meth:`tron.tracing.SurfelTracer.trace`.
        """
        if dr.grad_enabled(self.parameters.sh):
            self.parameters.sh_degree = MAX_SH_DEGREE
        return self.tracer.trace(origin, direction, active, values)

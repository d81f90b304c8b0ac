"""Images tinted per vertex: glTF multiplies a texture by the colours of the vertices."""

# pyright: reportArgumentType=false, reportIncompatibleMethodOverride=false, reportReturnType=false, reportAttributeAccessIssue=false
from __future__ import annotations

from functools import cache
from typing import Any

import mitsuba as mi

ATTRIBUTE = "vertex_tint"


def tinted(image: dict[str, Any]) -> Any:
    """Mitsuba texture: that of a dictionary, times the mesh's attribute ``vertex_tint``."""
    _register(str(mi.variant()))
    return mi.load_dict({"type": "tinted", "image": image})


@cache
def _register(_variant: str) -> None:
    """Make the plugin known to the variant in use; its class has to be made under it."""

    class Tinted(mi.Texture):
        """Product of a texture and a mesh attribute, both linear RGB."""

        def __init__(self, properties: mi.Properties):
            super().__init__(properties)
            self.image = properties["image"]

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
            return self.eval_3(si, active)

        def eval_3(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
            return self.image.eval_3(si, active) * si.shape.eval_attribute_3(ATTRIBUTE, si, active)

        def eval_1(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
            return mi.luminance(self.eval_3(si, active))

        def mean(self) -> mi.Float:
            return self.image.mean()

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"Tinted[{self.image}]"

    mi.register_texture("tinted", Tinted)

"""Settings of ``tron-datagen``, one model a mode."""

from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict

from tron.lazily import OneOf

if TYPE_CHECKING:
    from datagen.world.lights import Family, LightChoice
    from datagen.world.materials import ProceduralName
    from datagen.world.shapes import ThingName
    from datagen.world.styles import StyleChoice
else:  # words of registries whose rows need Mitsuba and SciPy
    Family = Annotated[str, OneOf("datagen.world.lights", "Family")]
    LightChoice = Annotated[str, OneOf("datagen.world.lights", "LightChoice")]
    ProceduralName = Annotated[str, OneOf("datagen.world.materials", "ProceduralName")]
    ThingName = Annotated[str, OneOf("datagen.world.shapes", "ThingName")]
    StyleChoice = Annotated[str, OneOf("datagen.world.styles", "StyleChoice")]

__all__ = ["Family", "LightChoice", "ProceduralName", "SettingsModel", "StyleChoice", "ThingName"]


class SettingsModel(BaseModel):
    """Settings that cannot change, refuse keys that they do not know, and hold finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

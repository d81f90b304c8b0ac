"""Settings of ``tron-datagen``, one model a mode."""

from pydantic import BaseModel, ConfigDict


class SettingsModel(BaseModel):
    """Settings that cannot change, refuse keys that they do not know, and hold finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

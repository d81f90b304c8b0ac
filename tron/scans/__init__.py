"""Opening a file of splats: everything that happens before a scan is lit, for commands and Python alike."""

from typing import TYPE_CHECKING, Literal

from tron.lazily import lazily

if TYPE_CHECKING:
    from tron.scans.scan import Scan

__all__ = ["GroundChoice", "Scan", "Treatment"]

GroundChoice = Literal["auto", "none"] | float
Treatment = Literal["drop", "background", "keep"]
"""Settings of the ground and of the surroundings, which wait for no scan."""

__getattr__ = lazily(__name__, {"scan": "Scan"})

"""The true maps of a capture, where it has any: path-traced views, and data sets that come with them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.errors import TronError
from tron.reconstruction.priors.prior import FIELDS, MapPrior, Maps


@dataclass(frozen=True)
class GroundTruth(MapPrior):
    """Gives every map that the training views have themselves: the most that any prior can do."""

    def fields(self, capture: Capture) -> Mapping[str, str]:
        """The fields that any training view has.

        Raises:
            TronError: no training view has any map.
        """
        held = [field for field in FIELDS if any(view.has(field) for view in capture.train_views)]
        if not held:
            raise TronError(
                "the capture has no true maps",
                mend="use the prior joint, precomputed or rgbx; path-traced views and TensoIR have truth",
            )
        return dict.fromkeys(held, "the capture's own, true")

    def prepare(self, capture: Capture, fields: Collection[str]) -> Maps:  # noqa: ARG002 (the protocol's)
        """Readers stay readers: nothing is read here."""

        def maps(view: View) -> Mapping[str, Pixels]:
            return {field: getattr(view, field) for field in fields if view.has(field)}

        return maps

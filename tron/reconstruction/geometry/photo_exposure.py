"""Exposure and white balance of each photo, found while surfels are learnt.

A camera meters every photo anew: in linear light, photo v shows g_v times, channel by channel, what the mean
photo would show. Left alone, surfels answer with colours that follow the camera, and with fog. The gains are
medians: each time that a view comes, of log(photo / picture) over pixels that surfels cover and that neither
clips; the surfels learn from the photo divided by its gain. The mean logarithm of all gains is held at zero,
since one factor common to all belongs to the light.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from tron.captures import View
from tron.captures.view import ToneCurve, decoded, encoded

_SAMPLES = 1 << 16
_PATCHES = 16
"""Patches along the longer side of a photo."""
_FEWEST = 8
_USABLE = 0.5
_COVERED = 0.9
_UNCLIPPED = (0.05, 0.95)
_BLEND = 0.5


class PhotoExposures:
    """Gains of the photos of a stage.

    Args:
        views: training views.
        curve: that their display values went through.
        begin: step from which gains are looked for: before, there is little to compare with.

    Attributes:
        gains: name of a view -> (3,) factors on linear light, those of photos that were seen; their mean
            logarithm is zero.
    """

    def __init__(self, views: Sequence[View], curve: ToneCurve, begin: int) -> None:
        self.curve: ToneCurve = curve
        self.begin = max(begin, len(views))
        self._place = {view.name: index for index, view in enumerate(views)}
        self._log = np.full((len(views), 3), np.nan)

    @property
    def gains(self) -> dict[str, np.ndarray]:
        """Gains of the photos that have one so far."""
        logs = self._centred()
        return {
            name: np.exp(logs[index]) for name, index in self._place.items() if np.isfinite(logs[index, 0])
        }

    def balanced(self, view: View, target: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The view's maps (see :func:`targets`) with its image as the mean photo would show it.

        A gain of one changes no bit.
        """
        log = self._centred()[self._place[view.name]]
        if "image" not in target or not np.isfinite(log[0]):
            return dict(target)
        image = target["image"]
        linear = decoded(image.cpu().numpy(), self.curve)
        moved = encoded(linear * np.exp(-log), self.curve) - encoded(linear, self.curve)
        shifted = image + torch.from_numpy(moved.astype(np.float32)).to(image.device)
        return {**target, "image": shifted.clamp(0, 1)}

    def observe(
        self, view: View, step: int, rendered: Mapping[str, Tensor], target: Mapping[str, Tensor]
    ) -> None:
        """Compare a photo, as stored, with the surfels' picture of its view.

        Args:
            view: the photo's.
            step: steps done.
            rendered: images of :func:`tron.tracing.torch_bridge.render`.
            target: the view's maps, its image as stored.
        """
        if step < self.begin or "image" not in target:
            return
        opacity, photo = rendered["opacity"].detach(), target["image"]
        usable = opacity > _COVERED
        for name, least in (("mask", _COVERED), ("valid", 0.5)):
            if name in target:
                usable = usable & (target[name] > least)
        picture = rendered["rgb"].detach() / opacity.clamp(min=_COVERED)[..., None]
        low, high = _UNCLIPPED
        for image in (photo, picture):
            usable = usable & (image > low).all(-1) & (image < high).all(-1)
        found = self._compared(*(each.cpu().numpy() for each in (photo, picture, usable)))
        if found is None:
            return
        index = self._place[view.name]
        before = self._log[index]
        self._log[index] = found if np.isnan(before[0]) else before + _BLEND * (found - before)

    def _compared(self, photo: np.ndarray, picture: np.ndarray, usable: np.ndarray) -> np.ndarray | None:
        """(3,) median over patches of log(photo / picture), linear; None where too few patches can be used.

        Patches, because surfels are blurred photos for long: the mean of a patch is what a blur keeps, the
        median of its logarithm is not.
        """
        step = max(1, round((photo[..., 0].size / _SAMPLES) ** 0.5))
        photo, picture, usable = (each[::step, ::step] for each in (photo, picture, usable))
        side = max(2, max(usable.shape) // _PATCHES)
        rows, columns = (length // side for length in usable.shape)
        weights = usable[: rows * side, : columns * side, None].astype(np.float64)

        def sums(values: np.ndarray) -> np.ndarray:
            return values.reshape(rows, side, columns, side, -1).sum((1, 3)).reshape(rows * columns, -1)

        share = sums(weights)[:, 0] / side**2
        kept = share > _USABLE
        light = np.stack(
            [
                sums(decoded(each[: rows * side, : columns * side], self.curve) * weights)
                for each in (photo, picture)
            ]
        )
        kept &= (light > 0).all((0, 2))  # the toe of a curve decodes to nothing
        if kept.sum() < _FEWEST:
            return None
        return np.median(np.log(light[0, kept]) - np.log(light[1, kept]), axis=0)

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint."""
        return {"photo_exposures": torch.from_numpy(self._log.copy())}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take up the state of a checkpoint."""
        self._log = tensors["photo_exposures"].numpy().copy()

    def _centred(self) -> np.ndarray:
        """(V, 3) logarithms less their mean; NaN of photos that were not compared yet.

        They are centred as they are used, not as they are kept: while surfels are darker than all photos, all
        that were compared lately would else seem bright.
        """
        compared = self._log[np.isfinite(self._log[:, 0])]
        return self._log - compared.mean(axis=0) if len(compared) else self._log

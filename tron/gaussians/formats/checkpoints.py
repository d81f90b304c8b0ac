"""Checkpoints of trainings: gsplat's, nerfstudio's Splatfacto, 3DGRUT's and 3DGS' own; weights alone.

``torch.load(weights_only=True)`` builds tensors and plain containers and refuses everything else. Layouts:
gsplat's examples/simple_trainer.py ("splats"), nerfstudio's models/splatfacto.py ("pipeline", gauss_params),
3DGRUT's threedgrut/model/model.py (get_model_parameters), 3DGS' scene/gaussian_model.py (capture). All hold
logarithms of scales and logits of opacities, (w, x, y, z), and coefficients before channels.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.gaussians.formats.splats import Z_UP, Splats, one_line
from tron.io.recognised import refuse_by_sight

_MEND = "export its splats there as PLY: `ns-export gaussian-splat` of nerfstudio, `save_ply` of gsplat"
_MOST_RECORDS = 100_000


def check(path: Path) -> None:
    """Raise TronError unless torch is there and a file is a ZIP of torch.save."""
    with one_line(path), zipfile.ZipFile(path) as file:
        names = file.namelist()
        if not any(name.endswith("data.pkl") for name in names) or len(names) > _MOST_RECORDS:
            refuse_by_sight(path, "a scene is a file of splats")
            raise TronError("no checkpoint of torch", path, _MEND)
        if any(each.compress_type != zipfile.ZIP_STORED for each in file.infolist()):
            raise TronError("a checkpoint whose records are compressed", path, _MEND)
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        raise TronError("checkpoints need torch", mend="pip install 'tron-relight[network]'") from error


def read(path: Path) -> Splats:
    """Splats of a checkpoint; nerfstudio and gsplat turn their worlds z up.

    Raises:
        TronError: it holds other objects than weights, no splats that are known, or is damaged.
    """
    check(path)
    import torch

    try:
        held = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # whatever damaged bytes make of it
        what = "it holds more than weights, or is damaged: only weights are read"
        raise TronError(what, path, _MEND) from error
    with one_line(path):
        return _Weights(path).of(held)


class _Weights:
    """Arrays of a checkpoint that take no more memory than the file."""

    def __init__(self, path: Path) -> None:
        self.path, self.left = path, path.stat().st_size

    def of(self, held: Any) -> Splats:
        if isinstance(held, Mapping) and isinstance(held.get("splats"), Mapping):
            return self._gsplat(held["splats"])
        if isinstance(held, Mapping) and isinstance(held.get("pipeline"), Mapping):
            return self._splatfacto(held["pipeline"])
        if isinstance(held, Mapping) and "features_albedo" in held:
            names = ("positions", "rotation", "scale", "density", "features_albedo", "features_specular")
            return self._made(*(held[name] for name in names), up=None)
        if isinstance(held, tuple) and held and isinstance(held[0], tuple) and len(held[0]) == 12:
            _, means, dc, rest, scales, quats, opacities = held[0][:7]
            return self._made(means, quats, scales, opacities, dc, rest, up=None)
        raise TronError("a checkpoint of no training that is known", self.path, _MEND)

    def _gsplat(self, held: Mapping[str, Any]) -> Splats:
        if "sh0" not in held:
            raise TronError("its colours are a network's (app_opt)", self.path, "train it without")
        names = ("means", "quats", "scales", "opacities", "sh0", "shN")
        return self._made(*(held[name] for name in names), up=Z_UP)

    def _splatfacto(self, held: Mapping[str, Any]) -> Splats:
        names = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
        for prefix in ("_model.gauss_params.", "_model."):
            if all(prefix + name in held for name in names):
                return self._made(*(held[prefix + name] for name in names), up=Z_UP)
        raise TronError("a checkpoint of nerfstudio that holds no splats", self.path, "train splatfacto")

    def _made(
        self, means: Any, quats: Any, scales: Any, opacities: Any, dc: Any, rest: Any,
        up: tuple[float, float, float] | None,
    ) -> Splats:  # fmt: skip
        means, quats, scales, opacities = map(self._array, (means, quats, scales, opacities))
        count = len(means)
        sh = [self._array(each).reshape(count, -1, 3) for each in (dc, rest)]
        return Splats(means, quats, scales, opacities.reshape(count), np.concatenate(sh, axis=1), up)

    def _array(self, tensor: Any) -> np.ndarray:
        import torch

        if not isinstance(tensor, torch.Tensor) or tensor.layout != torch.strided:
            raise TronError("its splats are no plain tensors", self.path, _MEND)
        self.left -= tensor.numel() * tensor.element_size()  # a view may be larger than what it lies in
        if self.left < 0:
            raise TronError("its tensors are larger than the file", self.path, _MEND)
        return tensor.detach().to(torch.float32).numpy()

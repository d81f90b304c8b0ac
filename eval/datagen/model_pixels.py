"""Pixels that show a user's models, in a scene of them among other things.

A dataset stores no object ids. A pixel's point, from its camera and its true depth, has the id of the surfel
whose centre is nearest; specifications say which ids are models.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.shards.schema import Clip

DEPTH = "depth_ref"
"""Member that the masks need."""


class ModelPixels:
    """Masks of the models of one scene.

    Args:
        scene: its folder in a dataset, with ``spec.json`` and ``surfels.ply``.

    Raises:
        TronError: one of the two is missing or damaged.
    """

    def __init__(self, scene: Path):
        path = scene / "spec.json"
        try:
            spec = json.loads(path.read_bytes())
            first = len(spec["surroundings"]) + 1
            models = [first + k for k, item in enumerate(spec["objects"]) if item["asset"] is not None]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TronError(
                f"no specification of a scene: {error}", path, "make its dataset again"
            ) from error
        surfels = GaussianScene.load(scene / "surfels.ply")
        self._centres = KDTree(surfels.means)
        self._is_model = np.isin(surfels.object_id, models)

    def masks(self, clip: Clip) -> np.ndarray:
        """(K, H, W) bool: pixels of a clip of the scene whose centre rays meet a model."""
        depths = clip.frames[DEPTH][..., 0]
        found = np.zeros(depths.shape, bool)
        for camera, depth, mask in zip(map(Camera.from_dict, clip.meta.cameras), depths, found):
            seen = depth > 0
            points = camera.position + camera.rays()[seen] * depth[seen, None]
            mask[seen] = self._is_model[self._centres.query(points)[1]]
        return found

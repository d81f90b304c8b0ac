"""Surfels at random, everything about them, every other as thick as splats are."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.gaussians.scene import GaussianScene, quats_from_matrices
from tron.seeds import generator


@pytest.fixture(scope="session")
def random_scene() -> Callable[..., GaussianScene]:
    """Makes a scene of so many surfels anew; fields may be given."""

    def make(count: int = 40, **fields) -> GaussianScene:
        rng = generator(0, "test", "scene")
        values = {
            "means": rng.normal(size=(count, 3)),
            "quats": quats_from_matrices(Rotation.random(count, rng).as_matrix()),
            "log_scales": rng.uniform(-4, -2, (count, 2)),
            "opacity_logits": rng.normal(size=count),
            "sh": rng.normal(size=(count, 16, 3)) * 0.1,
            "base_color": rng.uniform(size=(count, 3)),
            "roughness": rng.uniform(size=count),
            "metallic": rng.uniform(size=count),
            "object_id": np.arange(count) % 3,
            "spacing": 0.1,
        }
        values |= fields
        thick = np.asarray(values["log_scales"]).min(1) - rng.uniform(0.1, 2, count)
        values.setdefault("log_thickness", np.where(np.arange(count) % 2, -np.inf, thick))
        return GaussianScene(**values).validate()

    return make

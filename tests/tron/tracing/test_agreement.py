"""Three ways to the same sums over random scenes: tile lists, the hierarchy, and the float64 reference."""

from __future__ import annotations

from collections import Counter

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.tracing import Surface, SurfelTracer, reference

pytestmark = pytest.mark.usefixtures("variant")

THRESHOLD = 1e-6
"""A tenth of what would be allowed: at most 0.1% of all pixels may stand so near to a threshold."""
GAP = 1e-6
"""World units: hits nearer to each other than float32 can tell apart."""


def scene_of(seed: int, count: int, degree: int, size: float) -> GaussianScene:
    rng = seeds.generator(seed, "tests", "agreement", count, degree)
    quats = rng.normal(size=(count, 4))
    return GaussianScene(
        means=rng.uniform(-1, 1, (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=np.log(size * rng.uniform(0.3, 1, (count, 2))),
        opacity_logits=1 + 2 * rng.normal(size=count),
        sh=0.3 * rng.normal(size=(count, 16, 3)),
        base_color=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        object_id=np.zeros(count),
        kernel_degree=degree,
        spacing=0.05,
    ).validate()


def columns(seen: Surface) -> dict[str, np.ndarray]:
    """Sums of each ray, brought back from the normalised fields."""
    opacity = np.array(seen.opacity)
    fields = {name: np.array(getattr(seen, name)) for name in ("opacity", "depth", "lift")}
    fields["rgb"] = np.array(seen.rgb).T
    for name in ("base_color", "roughness", "metallic"):
        fields[name] = np.array(getattr(seen, name)).T * (
            opacity[:, None] if name == "base_color" else opacity
        )
    return fields


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**16),
    count=st.integers(1, 120),
    degree=st.sampled_from((2, 4)),
    size=st.sampled_from((0.15, 0.4)),
    distance=st.floats(0.5, 3.0),
)
def test_tiles_hierarchy_and_reference_agree(seed, count, degree, size, distance):
    scene = scene_of(seed, count, degree, size)
    camera = Camera.look_at((distance, 0.3, 0.4), (0, 0, 0), fov_deg=60, width=56, height=40)
    directions = camera.rays().reshape(-1, 3)
    origins = np.tile(camera.position, (len(directions), 1))
    truth = reference.composite(scene, origins, directions)
    steady, apart = truth.margin > THRESHOLD, truth.gap > GAP
    tally.update(pixels=len(directions), thresholds=(~steady).sum(), order=(steady & ~apart).sum())
    kept = steady & apart
    expected = {
        "opacity": 1 - truth.transmittance,
        "depth": truth.median_depth,
        "lift": truth.lift,
        **{name: getattr(truth, name) for name in ("rgb", "base_color", "roughness", "metallic")},
    }
    tracer = SurfelTracer(scene)
    by_tiles = columns(tracer.gbuffer(camera).rows())
    origin, direction = (mi.Point3f(np.float32(a).T.copy()) for a in (origins, directions))
    by_hierarchy = columns(tracer.trace(origin, mi.Vector3f(direction)))
    for name, values in expected.items():
        np.testing.assert_allclose(by_tiles[name][kept], values[kept], atol=1e-4, err_msg=f"tiles, {name}")
        np.testing.assert_allclose(
            by_hierarchy[name][kept], values[kept], atol=1e-4, err_msg=f"hierarchy, {name}"
        )


tally: Counter[str] = Counter()


def test_few_pixels_were_left_out():
    if not tally:
        test_tiles_hierarchy_and_reference_agree()
    assert tally["pixels"] > 10_000
    assert tally["thresholds"] < 1e-3 * tally["pixels"]
    assert tally["order"] < 1e-3 * tally["pixels"]

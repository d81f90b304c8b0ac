"""Families of materials: physical, seen, their own at every point, and one for every role."""

from typing import get_args

import numpy as np
import pytest
from pydantic import TypeAdapter

from datagen.world.materials import SOLIDS, MaterialSpec, draw_material
from datagen.world.materials.material import ALBEDO, BLOCK, ROUGHNESS
from datagen.world.materials.noise import gradient_noise, worley
from datagen.world.shapes.shape import Role
from tron.seeds import generator


@pytest.fixture(scope="module")
def surface():
    rng = generator(0, "surface")
    normals = rng.normal(size=(BLOCK + 3000, 3))
    return rng.uniform(-1, 1, normals.shape), normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("family", SOLIDS, ids=lambda family: family.__name__)
def test_a_family_is_physical_and_varies_over_its_surface(family, surface):
    for i, role in enumerate(family.roles):
        for large in (False, True):
            drawn = family.draw(generator(i, family.__name__), role, large=large)
            assert TypeAdapter(MaterialSpec).validate_json(drawn.to_json()) == drawn
            seen = drawn.evaluate(*surface)
            assert all(np.isfinite(values).all() for values in seen)
            assert seen.base_color.min() >= np.float32(ALBEDO[0])
            assert seen.base_color.max() <= np.float32(ALBEDO[1])
            assert seen.roughness.min() >= np.float32(ROUGHNESS[0])
            assert seen.roughness.max() <= np.float32(ROUGHNESS[1])
            assert seen.metallic.min() >= 0.0
            assert seen.metallic.max() <= 1.0
            assert np.abs(seen.height).max() < 0.15
            assert seen.base_color.std(axis=0).max() > 1e-3, "texture must be seen"
            part = drawn.evaluate(surface[0][9000:], surface[1][9000:])
            for whole, some in zip(seen, part):
                np.testing.assert_allclose(whole[9000:], some, atol=2e-5)


def test_every_role_has_a_family():
    for role in get_args(Role):
        for i in range(4):
            assert role in draw_material(generator(i, role), role).roles


def test_gradient_noise_is_smooth_centred_and_zero_on_the_lattice():
    points = generator(1, "noise").uniform(-40, 40, (3, 20_000)).astype(np.float32)
    values = gradient_noise(points)
    assert abs(values.mean()) < 0.02
    assert np.abs(values).max() < 1.5
    step = gradient_noise(points + np.float32(1e-2)) - values
    assert np.abs(step).max() < 0.08
    np.testing.assert_allclose(gradient_noise(np.floor(points)), 0.0, atol=1e-6)


def test_distances_to_cells_are_continuous():
    grid = np.stack(np.meshgrid(*[np.arange(0.005, 3, 0.06)] * 3, indexing="ij")).reshape(3, -1)
    found = worley(grid.astype(np.float32))
    assert (found.first <= found.second).all()
    # Distances cannot change faster than the points move.
    moved = worley((grid + 0.01).astype(np.float32))
    assert np.abs(moved.first - found.first).max() <= 0.01 * np.sqrt(3) + 1e-4
    assert np.abs(moved.second - found.second).max() <= 0.01 * np.sqrt(3) + 1e-4
    assert found.first.min() < 0.1

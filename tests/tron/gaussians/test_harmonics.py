"""Real spherical harmonics: against SciPy's complex ones, orthonormality, and rotation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import roots_legendre, sph_harm_y

from tron.gaussians import harmonics
from tron.seeds import generator


def directions(count: int) -> np.ndarray:
    vectors = generator(0, "test", "harmonics").normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_basis_is_the_real_part_of_the_complex_harmonics():
    d = directions(200)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            part = value.real if order >= 0 else value.imag
            expected.append(part * (np.sqrt(2) if order else 1))
    np.testing.assert_allclose(harmonics.sh_matrix(d), np.stack(expected, axis=1), atol=1e-12)


def test_signs_are_those_of_the_3dgs_code():
    # SH_C1 * (-y, z, -x) and the first constants of degrees 2 and 3, as the reference prints them.
    x, y, z = 0.36, 0.48, 0.8
    basis = harmonics.sh_basis(x, y, z)
    assert basis[1:4] == pytest.approx(
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    )
    assert basis[4] == pytest.approx(1.0925484305920792 * x * y)
    assert basis[5] == pytest.approx(-1.0925484305920792 * y * z)
    assert basis[9] == pytest.approx(-0.5900435899266435 * y * (3 * x * x - y * y))
    assert basis[14] == pytest.approx(1.445305721320277 * z * (x * x - y * y))


def test_basis_is_orthonormal():
    # Gauss-Legendre in z and even steps in azimuth integrate polynomials of degree 6 exactly.
    z, weight = roots_legendre(8)
    phi = np.arange(16) * 2 * np.pi / 16
    radius = np.sqrt(1 - z**2)[:, None]
    d = np.stack(np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), z[:, None]), axis=-1)
    basis = harmonics.sh_matrix(d)
    gram = np.einsum("i,ijk,ijl->kl", weight * 2 * np.pi / 16, basis, basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_colour_is_clamped_below_and_dc_is_its_mean():
    rgb = np.array([0.2, 0.5, 0.9])
    sh = np.zeros((16, 3))
    sh[0] = harmonics.rgb_to_dc(rgb)
    np.testing.assert_allclose(harmonics.eval_sh(sh, directions(5)[0]), rgb)
    np.testing.assert_allclose(harmonics.dc_to_rgb(sh[0]), rgb)
    sh[0] = harmonics.rgb_to_dc(np.array([-1.0, 0.0, 2.0]))
    np.testing.assert_allclose(harmonics.eval_sh(sh, directions(5)[0]), [0, 0, 2], atol=1e-12)


def test_rotated_radiance_is_the_same_seen_from_the_turned_side():
    d = directions(50)
    rotation = Rotation.from_euler("xyz", [0.3, -1.2, 2.5]).as_matrix()
    sh = generator(0, "test", "coefficients").normal(size=(4, 16, 3)) * 0.05
    turned = harmonics.rotate_sh(sh, rotation)
    before = harmonics.eval_sh(sh[:, None], d)
    np.testing.assert_allclose(harmonics.eval_sh(turned[:, None], d @ rotation.T), before, atol=1e-10)
    # Degrees do not mix: each keeps its energy.
    for low, high in ((0, 1), (1, 4), (4, 9), (9, 16)):
        np.testing.assert_allclose(
            (turned[:, low:high] ** 2).sum((1, 2)), (sh[:, low:high] ** 2).sum((1, 2)), rtol=1e-9
        )

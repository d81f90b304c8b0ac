"""Laws of the sample points: uniform, stratified in every pixel and block of pixels, blue in the image."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.shading.direct.sampling import PixelPoints

WIDTH = 64


def drawn(count: int, seed: int = 0, which: int = 0, rows: int = WIDTH) -> np.ndarray:
    """(rows, WIDTH, count, 2) points of an image."""
    points = PixelPoints.make(count, 2, WIDTH, seed, "tests")
    lane = dr.arange(mi.UInt32, WIDTH * rows * count)
    run = points.run(lane // count)
    values = np.array(points.point(run, lane % count, mi.UInt32(which)))
    return values.T.reshape(rows, WIDTH, count, 2)


def is_net(points: np.ndarray) -> bool:
    """Whether 2^k points (N, 2^k, 2) are (0, k, 2)-nets: one in each dyadic rectangle of area 2^-k."""
    size = points.shape[1]
    k = size.bit_length() - 1
    for a in range(k + 1):
        cell = np.floor(points * [1 << a, 1 << (k - a)]).astype(int)
        index = cell[..., 0] * (1 << (k - a)) + cell[..., 1]
        if (np.sort(index, axis=1) != np.arange(size)).any():
            return False
    return True


def blocks(points: np.ndarray, size: int) -> np.ndarray:
    """(N, size^2 count, 2): the points of each block of ``size`` squared pixels."""
    rows, width, count, _ = points.shape
    tiles = points.reshape(rows // size, size, width // size, size, count, 2).transpose(0, 2, 1, 3, 4, 5)
    return tiles.reshape(-1, size * size * count, 2)


@pytest.mark.parametrize("count", [1, 2, 8, 32])
def test_every_pixel_and_every_block_of_pixels_holds_a_net(variant: str, count: int) -> None:
    points = drawn(count, rows=16)
    for size in (1, 2, 4, 8):
        assert is_net(blocks(points, size)), size


def test_points_without_structure_are_no_net(variant: str) -> None:
    shuffled = drawn(8, rows=16).copy()
    np.random.Generator(np.random.PCG64(0)).shuffle(shuffled.reshape(-1, 2))
    assert not is_net(blocks(shuffled, 1))


@pytest.mark.parametrize("count", [3, 5, 6, 50])
def test_other_numbers_leave_no_stratum_out_everywhere(variant: str, count: int) -> None:
    """What every pixel leaves out is an error of the whole image, which no filter removes."""
    points = drawn(count).reshape(-1, 2)
    for axis in (0, 1):
        share = np.histogram(points[:, axis], bins=64, range=(0, 1))[0] / len(points)
        np.testing.assert_allclose(share, 1 / 64, rtol=0.05)


@pytest.mark.parametrize("count", [16, 32])
def test_all_pixels_take_their_strata_in_one_order_and_neighbours_follow_each_other(variant, count) -> None:
    points = drawn(count, rows=16)
    k = count.bit_length() - 1
    cell = np.floor(points * [1 << (k // 2), 1 << (k - k // 2)])
    assert (cell == cell[0, 0]).all()
    fours = points.reshape(*points.shape[:2], count // 4, 4, 2)
    area = np.prod(np.ptp(np.floor(fours * [1 << (k // 2), 1 << (k - k // 2)]), axis=3) + 1, axis=-1)
    assert (area == 4).all()


@pytest.mark.parametrize("count", [1, 6, 32])
def test_each_point_is_uniform_over_seeds(variant: str, count: int) -> None:
    """Chi-square of one pixel's points over 8 x 8 cells and 400 seeds, pooled; 63 degrees of freedom."""
    points = np.concatenate([drawn(count, seed, rows=1)[0, 5] for seed in range(400)])
    seen = np.histogram2d(*points.T, bins=8, range=[[0, 1], [0, 1]])[0]
    assert ((seen - seen.mean()) ** 2).sum() / seen.mean() < 120
    assert points.min() >= 0
    assert points.max() < 1


def integrand(p: np.ndarray) -> np.ndarray:
    return np.cos(3 * p[..., 0] + 2 * p[..., 1] ** 2)


def test_errors_of_sets_and_seeds_are_unrelated(variant: str) -> None:
    first, *others = (integrand(drawn(4, **key)).mean(-1).ravel() for key in ({}, {"seed": 1}, {"which": 1}))
    for other in others:
        assert abs(np.corrcoef(first, other)[0, 1]) < 0.1


def test_error_is_blue_and_blocks_of_pixels_average_it_away(variant: str) -> None:
    """A smooth integrand, one point a pixel: blocks of pixels know it better than independent points."""
    fine = np.stack(np.meshgrid(*[(np.arange(512) + 0.5) / 512] * 2), -1)
    error = integrand(drawn(1))[..., 0] - integrand(fine).mean()
    for size in (2, 4, 8):
        block = error.reshape(WIDTH // size, size, WIDTH // size, size).mean((1, 3))
        assert block.std() < 0.6 * error.std() / size  # independent errors: error.std() / size
    spectrum = np.abs(np.fft.fft2(error)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(WIDTH), np.fft.fftfreq(WIDTH)))
    low = spectrum[(frequency > 0) & (frequency < 0.1)].mean()
    assert low < 0.2 * spectrum[frequency > 0.3].mean()

"""Laws of the matching: windows compared as a slow loop compares them, least cost where the surface is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tron.cameras import Camera
from tron.captures import View
from tron.reconstruction.geometry.matching import (
    COLOUR_LIMIT,
    Photograph,
    agreed_cost,
    matching_cost,
    project,
    refined_minimum,
    window_mean,
)
from tron.seeds import generator

SIZE = 40


def wall_view(x: float, *, gain: float = 1.0, slant: float = 0.0) -> Photograph:
    """A photograph, from (x, 0, -4), of the wall z = slant x, painted in waves."""
    camera = Camera.look_at((x, 0, -4), (0, 0, 0), up=(0, 1, 0), fov_deg=40, width=SIZE, height=SIZE)
    rays = camera.rays().astype(np.float64)
    distance = wall_distance(camera, slant)
    points = camera.position + distance[..., None] * rays
    phases = np.array([0.0, 1.0, 2.0])
    waves = np.sin(9 * points[..., :1] + 2 * phases) * np.cos(7 * points[..., 1:2] + phases)
    image = gain * (0.4 + 0.25 * waves)
    return Photograph.of(View(f"{x}", camera, image, "display"), 512, "cpu")


def wall_distance(camera: Camera, slant: float = 0.0) -> np.ndarray:
    """(H, W) along the rays to z = slant x."""
    rays, eye = camera.rays().astype(np.float64), camera.position
    return (slant * eye[0] - eye[2]) / (rays[..., 2] - slant * rays[..., 0])


def hypotheses(photograph: Photograph, relative: list[float], slant: float = 0.0) -> torch.Tensor:
    truth = torch.from_numpy(wall_distance(photograph.camera, slant)).float()
    return torch.stack([factor * truth for factor in relative])


@pytest.mark.parametrize("radius", [1, 2])
def test_window_means_are_those_of_a_loop(radius: int) -> None:
    values = generator(0, "window").random((7, 9))
    expected = [
        [
            values[max(r - radius, 0) : r + radius + 1, max(c - radius, 0) : c + radius + 1].mean()
            for c in range(9)
        ]
        for r in range(7)
    ]
    np.testing.assert_allclose(window_mean(torch.from_numpy(values), radius).numpy(), expected, rtol=1e-12)


def test_pixels_are_those_of_the_camera() -> None:
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), fov_deg=50, width=30, height=20)
    points = generator(0, "project").normal(size=(50, 3)) * 0.5
    pixels, z = project(camera, torch.from_numpy(points))
    expected, depth = camera.project(points)
    np.testing.assert_allclose(pixels.numpy(), expected, rtol=1e-9)
    np.testing.assert_allclose(z.numpy(), depth, rtol=1e-9)


def test_the_cost_is_that_of_a_slow_loop_over_windows() -> None:
    one, other = wall_view(0.0), wall_view(0.5)
    distances = hypotheses(one, [0.9, 1.0, 1.07])
    found = matching_cost(one, other, distances, radius=2)
    own = one.image.double().numpy()
    for k in range(3):
        points = one.camera.position + distances[k].double().numpy()[..., None] * one.camera.rays()
        pixels, _ = other.camera.project(points.reshape(-1, 3))
        warped = bilinear(other.image.double().numpy(), pixels).reshape(3, SIZE, SIZE)
        for row, column in [(20, 20), (12, 25), (30, 9)]:
            window = (slice(row - 2, row + 3), slice(column - 2, column + 3))
            a, b = own.mean(0)[window].ravel(), warped.mean(0)[window].ravel()
            covariance = ((a - a.mean()) * (b - b.mean())).mean()
            zncc = (covariance + 1e-4) / np.sqrt((a.var() + 1e-4) * (b.var() + 1e-4))
            apart = np.abs(own[:, *window] - warped[:, *window]).mean()
            cost = 0.5 * np.clip(1 - zncc, 0, 1) + 0.5 * min(apart / COLOUR_LIMIT, 1)
            assert float(found[k, row, column]) == pytest.approx(cost, abs=2e-4)


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(C, N) values between pixel centres, 0 beside the image."""
    x, y = (pixels - 0.5).T
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros((len(image), len(pixels)))
    for right in (0, 1):
        for down in (0, 1):
            c, r = column + right, row + down
            weight = (1 - np.abs(x - c)) * (1 - np.abs(y - r))
            inside = (c >= 0) & (r >= 0) & (c < image.shape[2]) & (r < image.shape[1])
            total += weight * inside * image[:, np.where(inside, r, 0), np.where(inside, c, 0)]
    return total


@pytest.mark.parametrize("slant", [0.0, 0.8])
def test_the_cost_is_least_on_the_surface_however_it_slants(slant: float) -> None:
    one, others = wall_view(0.0, slant=slant), [wall_view(x, slant=slant) for x in (-0.6, 0.6)]
    relative = [0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06]
    cost = agreed_cost(one, others, hypotheses(one, relative, slant), 2, best=2)[:, 8:-8, 8:-8]
    assert (cost.argmin(0) == 3).float().mean() > 0.95
    place, _ = refined_minimum(cost)
    assert float((place - 3).abs().median()) < 0.1


def test_exposure_changes_half_of_the_cost_alone() -> None:
    one, other, darker = wall_view(0.0), wall_view(0.5), wall_view(0.5, gain=0.6)
    distances = hypotheses(one, [1.0])
    alike = matching_cost(one, other, distances, 2)[0, 8:-8, 8:-8]
    apart = matching_cost(one, darker, distances, 2)[0, 8:-8, 8:-8]
    assert float(alike.median()) < 0.05
    assert 0.3 < float(apart.median()) < 0.53  # the colours' half, and nothing of the correlation's


def test_what_another_photograph_does_not_show_or_hides_behind_a_mask_costs_most() -> None:
    one, other = wall_view(0.0), wall_view(0.5)
    far = matching_cost(one, other, hypotheses(one, [-1.0]), 2)  # behind both cameras
    assert (far == 1).all()
    hidden = Photograph(other.camera, other.image, torch.zeros_like(other.subject))
    assert (matching_cost(one, hidden, hypotheses(one, [1.0]), 2) == 1).all()


def test_a_large_photograph_is_reduced_and_its_camera_with_it() -> None:
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), up=(0, 1, 0), fov_deg=40, width=64, height=32)
    image = np.zeros((32, 64, 3))
    image[:, 32:] = 1
    small = Photograph.of(View("wide", camera, image, "display"), 16, "cpu")
    assert (small.camera.width, small.camera.height) == (16, 8)
    assert small.image.shape == (3, 8, 16)
    assert (small.image[:, :, :8] == 0).all()
    assert (small.image[:, :, 8:] == 1).all()
    np.testing.assert_allclose(small.camera.fov_deg, camera.fov_deg)

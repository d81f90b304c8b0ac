"""Alpha becomes geometry: what is left has the mask's area, place, texture and colours."""

# pyright: reportArgumentType=false, reportOptionalSubscript=false

from dataclasses import replace

import numpy as np
import pytest

import tron.models.alpha
from tron.models.alpha import without_clear
from tron.models.parts import Part, Sampling
from tron.seeds import generator

QUAD = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def card(repeats=1.0, wrap="repeat", **more):
    uv = (QUAD[:, :2] * repeats).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    color, normal = np.full((8, 8, 3), 0.5, np.float32), np.tile((0.0, 0, 1), (4, 1))
    sampling = {"base_color": Sampling(np.eye(3), wrap)}
    return Part(QUAD, normal, faces, uv, color, 1.0, 0.0, None, sampling=sampling, **more)


def doubled_areas(part):
    """(F,) twice the signed area of triangles in the plane z = 0."""
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)[:, 2]


def area(part):
    return 0.5 * np.abs(doubled_areas(part)).sum()


def disk(size=256, radius=0.35):
    x, y = (np.mgrid[:size, :size][::-1] + 0.5) / size
    return (np.hypot(x - 0.5, y - 0.5) < radius).astype(np.float32)


def test_a_disk_is_cut_out_of_a_card():
    part = without_clear(card(), disk(), 0.5, None)
    assert area(part) == pytest.approx(np.pi * 0.35**2, rel=0.02)
    assert (doubled_areas(part) > 0).all(), "pieces face as their triangle did"
    used = np.unique(part.faces)
    corners = part.vertices[used]
    assert np.hypot(*(corners[:, :2] - 0.5).T).max() < 0.35 + 0.03
    np.testing.assert_allclose(part.uv[used], corners[:, :2], atol=1e-6)


@pytest.mark.parametrize(("wrap", "expected"), [("repeat", 0.5), ("mirror", 0.5), ("clamp", 0.25)])
def test_the_mask_goes_on_as_the_texture_does(wrap, expected):
    """A mask whose left half is opaque, over a card that it covers 2 x 2 times."""
    alpha = np.zeros((64, 64), np.float32)
    alpha[:, :32] = 1
    part = without_clear(card(2.0, wrap), alpha, 0.5, None)
    assert area(part) == pytest.approx(expected, abs=0.02)
    along = part.vertices[part.faces].mean(axis=1)[:, 0]
    if wrap == "mirror":
        assert ((along < 0.27) | (along > 0.73)).all()
    if wrap == "repeat":
        assert ((along % 0.5) < 0.27).all()


def test_opaque_and_clear_triangles_are_left_as_they_are():
    assert len(without_clear(card(), np.ones((4, 4)), 0.5, None).faces) == 2
    assert len(without_clear(card(), np.full((4, 4), 0.4), 0.5, None).faces) == 0
    kept = without_clear(card(), np.ones((1, 1)), 0.5, np.array([1.0, 0, 0, 1]))
    assert kept.faces.tolist() == [[0, 2, 3]]


def test_each_triangle_is_cut_at_its_own_share_of_the_alpha_of_its_vertices():
    # Alpha rises from left to right; halved, it is opaque only where it was 1 before.
    alpha = np.tile((np.arange(64) + 0.5) / 64, (64, 1)).astype(np.float32)
    apart = card()
    apart = replace(apart, faces=np.array([[0, 1, 2], [3, 4, 5]]), **{
        name: getattr(apart, name)[[0, 1, 2, 0, 2, 3]] for name in ("vertices", "normals", "uv")
    })  # fmt: skip
    part = without_clear(apart, alpha, 0.45, np.array([1.0, 1, 1, 0.5, 0.5, 0.5]))
    corners = part.vertices[part.faces]
    centre = corners.mean(axis=1)
    lower = centre[:, 0] > centre[:, 1]
    assert corners[lower][..., 0].min() == pytest.approx(0.45, abs=0.05)
    assert corners[~lower][..., 0].min() == pytest.approx(0.9, abs=0.05)


def test_what_vertices_carry_is_interpolated():
    tint = np.column_stack([QUAD[:, 0], QUAD[:, 1], np.ones(4)]).astype(np.float32)
    part = without_clear(card(tint=tint), disk(), 0.5, None)
    used = np.unique(part.faces)
    np.testing.assert_allclose(part.tint[used, :2], part.vertices[used, :2], atol=1e-6)


def test_noise_is_cut_no_further_than_the_budget(monkeypatch):
    monkeypatch.setattr(tron.models.alpha, "MOST_PIECES", 2000)
    noise = generator(0, "noise").random((512, 512)) < 0.5
    part = without_clear(card(), noise.astype(np.float32), 0.5, None)
    assert 100 < len(part.faces) <= 2000

"""Histograms against closed forms: lengths of silhouettes, shares of light, sums over clips."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from datagen.dataset.records import read_record
from datagen.dataset.variety import (
    MEASURES,
    frame_histograms,
    median,
    shard_histograms,
    silhouette_length,
    total,
)
from datagen.run.account import read_other
from tron.cameras import Camera
from tron.shards.manifest import Manifest

SIZE = 128
CAMERA = Camera.look_at((0, 0, 0), (0, 1, 0), fov_deg=50, width=SIZE, height=SIZE)
CAMERA_AXIS_Z = CAMERA.world_to_camera[2, :3]


def plane_distance(normal: Sequence[float], offset: float) -> np.ndarray:
    """(H, W) distance along each ray to the plane normal . x = offset; infinite where it is not met."""
    cosine = CAMERA.rays() @ np.asarray(normal, float)
    with np.errstate(divide="ignore"):
        distance = offset / cosine
    return np.where(distance > 0, distance, np.inf)


def ball_distance(centre: np.ndarray, radius: float) -> np.ndarray:
    """(H, W) distance along each ray to a ball; infinite where it is not met."""
    rays = CAMERA.rays()
    along = rays @ centre
    under = radius**2 - (centre @ centre - along**2)
    return np.where(under > 0, along - np.sqrt(np.maximum(under, 0)), np.inf)


def length(*distances: np.ndarray) -> float:
    nearest = np.minimum.reduce(distances)
    seen = np.isfinite(nearest)
    return silhouette_length(np.where(seen, nearest, 0), seen, CAMERA)


def test_the_silhouette_of_a_disk_is_as_long_as_the_square_around_it():
    """Lines between pixels run along rows and columns: a disk's outline is that of its bounding square."""
    for y in (4.0, 8.0):
        ball = ball_distance(np.array([0, y, 0]), 1.0)
        side = np.isfinite(ball).any(axis=0).sum() / SIZE
        assert length(ball) == pytest.approx(4 * side, rel=1e-9)


def test_a_plane_has_no_silhouette_however_it_is_tilted_and_a_ball_before_it_has_one():
    for tilt in (0.02, 0.3, 1.5):
        floor = plane_distance([0, np.sin(tilt), np.cos(tilt)], np.cos(tilt) * -1.0)
        horizon = np.isfinite(floor)
        if horizon.all():
            assert length(floor) == 0
        else:
            assert length(floor) <= 1.1  # where it ends, at most
        floor_alone = length(floor)
        ball = ball_distance(np.array([0.2, 3.0, 0.4]), 0.5)
        side = np.isfinite(ball).any(axis=0).sum() / SIZE
        assert length(floor, ball) - floor_alone == pytest.approx(4 * side, rel=0.15)


def test_the_edge_between_two_walls_is_no_silhouette():
    left, right = plane_distance([-0.6, 0.8, 0], 4.0), plane_distance([0.6, 0.8, 0], 4.0)
    assert length(np.maximum(left, right)) == 0


def frame() -> dict[str, np.ndarray]:
    seen = np.zeros((SIZE, SIZE, 1), np.float32)
    seen[:, : SIZE // 4] = 1
    light = np.full((SIZE, SIZE, 3), 2.0, np.float32)
    return {
        "foreground": seen,
        "unshadowed": light,
        "irradiance": np.where(seen > 0, 0.75 * light, 5 * light),  # what is not foreground does not count
        "lit": light,
        "shadowed": 0.875 * light,
        "base_color_ref": np.broadcast_to(np.full(3, 0.5, np.float32), (SIZE, SIZE, 3)),
        "roughness_ref": np.full((SIZE, SIZE, 1), 0.31, np.float32),
        "metallic_ref": np.full((SIZE, SIZE), 1.0, np.float32),
        "depth_ref": np.full((SIZE, SIZE, 1), 1000.0, np.float32),
    }


def test_each_measure_counts_what_it_says():
    found = frame_histograms(frame(), CAMERA, contrast=0.52)
    assert list(found) == list(MEASURES)
    pixels = SIZE * SIZE // 4
    for name, measure in MEASURES.items():
        assert sum(found[name]) == (pixels if measure.counted == "pixels" else 1)
    expected: dict[str, float] = {
        "coverage": 0.25,
        "albedo": 0.5,
        "roughness": 0.31,
        "metallic": 1.0,
        "contrast": 0.52,
    }
    expected |= {"shadow": 0.25, "bounce": 0.125, "depth": 100.0}  # beyond the last bin counts in it
    for name, value in expected.items():
        edges = MEASURES[name].edges
        k = int(np.flatnonzero(found[name])[0])
        assert edges[k] - 1e-6 <= value <= edges[k + 1] + 1e-6, name
    assert median("roughness", found["roughness"]) == pytest.approx(0.325)


def test_what_was_never_counted_has_no_median():
    assert np.isnan(median("albedo", [0] * 20))
    assert np.isnan(median("albedo", []))
    assert median("albedo", [0] * 19 + [1]) == pytest.approx(0.975)


def test_members_that_are_not_there_are_not_counted():
    less = {name: image for name, image in frame().items() if not name.endswith("_ref")}
    assert set(frame_histograms(less, CAMERA)) == {"coverage", "shadow", "bounce"}
    dark = frame() | {"unshadowed": np.zeros((SIZE, SIZE, 3)), "lit": np.zeros((SIZE, SIZE, 3))}
    assert {"shadow", "bounce"}.isdisjoint(frame_histograms(dark, CAMERA)), "there is no light to take"


def test_bins_of_another_version_are_left_out():
    one = frame_histograms(frame(), CAMERA)
    assert total([one, one | {"albedo": [1, 2]}, {"unheard_of": [1]}])["albedo"] == one["albedo"]
    assert total([one, one])["depth"] == [2 * count for count in one["depth"]]


def test_the_records_of_a_dataset_agree_with_its_shards(small_dataset: Path, tmp_path: Path):
    """Shards hold half floats, so a few values change their bin; of training scenes they hold no truth."""
    records = [read_record(small_dataset, f"{split}-000000") for split in ("train", "train_b", "test")]
    counted = {record.name: record.variety for record in records if record}
    assert all(list(each) == list(MEASURES) for each in counted.values())
    manifest = Manifest.load(small_dataset)
    for split in ("train", "test"):
        part = tmp_path / split
        part.mkdir()
        shards = [entry for entry in manifest.of_split(split) if entry.keys[0].startswith(f"{split}-000000")]
        manifest.model_copy(update={"shards": shards}).save(part)
        for entry in shards:
            shutil.copy(small_dataset / entry.name, part)
        found = shard_histograms(part)
        assert set(found) == (
            set(MEASURES) if split == "test" else {"contrast", "coverage", "shadow", "bounce"}
        )
        for name, counts in found.items():
            recorded = np.array(counted[f"{split}-000000"][name])
            assert recorded.sum() == sum(counts) > 0
            assert np.abs(recorded - counts).sum() <= 0.05 * recorded.sum(), name
        assert read_other(part) == {split: found}, "it has no records"
    (everything,) = read_other(small_dataset).values()
    assert sum(everything["contrast"]) == sum(entry.samples for entry in manifest.shards)

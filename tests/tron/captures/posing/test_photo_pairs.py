"""Photos that show the same are paired, those that do not are not, and no photo is left alone."""

from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tron.captures.posing.structure_from_motion import coarse_descriptors, overlapping_pairs
from tron.seeds import generator

COUNT = 30


def unit(values: np.ndarray) -> np.ndarray:
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


def walk_around(reach: int = 4, each: int = 12) -> list[np.ndarray]:
    """Photos on a ring: each shows its own features and those of the ``reach`` next to it on either side."""
    draw = generator(0, "ring")
    places = unit(draw.random((COUNT, each, 128)))
    photos = []
    for index in range(COUNT):
        shown = np.concatenate([places[(index + step) % COUNT] for step in range(-reach, reach + 1)])
        seen = unit(shown + 0.02 * draw.standard_normal(shown.shape) / np.sqrt(128))
        photos.append(seen[draw.permutation(len(seen))])
    return photos


def test_photos_are_paired_with_those_that_show_most_of_the_same() -> None:
    pairs = overlapping_pairs(walk_around(), 6)
    steps = [min((j - i) % COUNT, (i - j) % COUNT) for i, j in pairs]
    assert sorted(steps) == [1] * COUNT + [2] * COUNT + [3] * COUNT
    assert all(i < j for i, j in pairs)


def test_few_photos_are_paired_with_all_others() -> None:
    nothing = [np.zeros((0, 128), np.float32)] * 5
    assert overlapping_pairs(nothing, 4) == [(i, j) for i in range(5) for j in range(i + 1, 5)]


def test_two_groups_that_share_little_are_connected_where_they_share_most() -> None:
    draw = generator(1, "groups")
    common = [unit(draw.random((40, 128))) for _ in range(2)]
    photos = [common[index // 8] for index in range(16)]
    bridge = unit(draw.random((5, 128)))
    photos[3], photos[12] = (np.concatenate([photos[index], bridge]) for index in (3, 12))
    pairs = overlapping_pairs(photos, 3)
    i, j = np.array(pairs).T
    assert connected_components(coo_array((np.ones(len(pairs)), (i, j)), (16, 16)), directed=False)[0] == 1
    assert [(i, j) for i, j in pairs if i < 8 <= j] == [(3, 12)]


def test_the_largest_features_are_taken(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    draw = generator(2, "features")
    scale = draw.permutation(np.linspace(1, 20, 900)).astype(np.float32)
    turn = draw.uniform(0, 2 * np.pi, 900)
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    keypoints = np.stack([*draw.uniform(0, 99, (2, 900)), cos, -sin, sin, cos], axis=1).astype(np.float32)
    values = draw.integers(0, 255, (900, 128), dtype=np.uint8)
    store = pycolmap.Database.open(tmp_path / "database.db")
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.OPENCV, 100.0, 100, 100)
    camera_id = store.write_camera(camera)
    image = store.write_image(pycolmap.Image(name="camera_000/00000.jpg", camera_id=camera_id))
    store.write_keypoints(image, keypoints)
    kind = pycolmap.FeatureExtractorType.SIFT
    store.write_descriptors(image, pycolmap.FeatureDescriptors(kind, values))
    store.close()

    ((name, found),) = coarse_descriptors(tmp_path / "database.db").items()
    assert name == "camera_000/00000.jpg"
    largest = values[np.sort(np.argsort(-scale)[:250])]
    np.testing.assert_allclose(found, unit(largest.astype(float)), atol=1e-6)

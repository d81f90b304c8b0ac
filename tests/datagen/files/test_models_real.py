"""The real models: read as another library reads them, and visible as what they are."""

# pyright: reportAttributeAccessIssue=false

import json
import struct
from functools import cache

import numpy as np
import pytest
import trimesh

from datagen.truth.build import Geometry, _of_model
from datagen.truth.pathtrace import gbuffers
from tron.cameras import Camera
from tron.models import load
from tron.models.gltf.meshes import read_parts

MODELS = {
    "FlightHelmet/FlightHelmet.gltf": (94_000, 0.1),
    "GolfBall/GolfBall.glb": (356, 0.5),
    "cat/cat.glb": (4_622, 0.1),
    "chess-board/chess-board.glb": (178_000, 0.1),
    "house/house.glb": (8_000, 0.2),
    "spot/spot.obj": (5_856, 0.15),
}
"""Model -> fewest triangles, and least share of a picture that it fills from either side."""


CUT = ("FlightHelmet", "house")
"""Models whose alpha cuts some triangles."""


@cache
def load_model(path):
    return load.load_model(path)


def corners(parts):
    """Triangles (F, 3, 3) in an order of their own."""
    found = np.round(np.concatenate([part.vertices[part.faces] for part in parts]).reshape(-1, 9), 4)
    return found[np.lexsort(found.T)]


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_seen_from_both_sides(shared_data, variant, name):
    parts = load_model(shared_data / "assets" / name)
    triangles, share = MODELS[name]
    assert sum(len(part.faces) for part in parts) >= triangles
    geometry = Geometry([_of_model(part, 2, i) for i, part in enumerate(parts)])
    cameras = [
        Camera.look_at((2.5 * x, -2.5 * x, 1.2), (0, 0, 0), fov_deg=38, width=48, height=48)
        for x in (0.7, -0.7)
    ]
    for view in gbuffers(geometry, cameras):
        assert view.valid.mean() > share
        color = view.base_color[view.valid]
        assert color.mean() > 0.01
        assert np.isfinite(view.normal[view.valid]).all()


@pytest.mark.parametrize(
    "name", [name for name in MODELS if name.endswith(("b", "f")) and "chess" not in name]
)
def test_triangles_are_those_that_trimesh_reads(shared_data, name):
    path = shared_data / "assets" / name
    theirs = trimesh.load_scene(path, process=False).to_geometry()
    ours = read_parts(path, 10**6)
    wanted = np.round(np.asarray(theirs.triangles).reshape(-1, 9), 4)
    wanted = wanted[np.lexsort(wanted.T)]
    found = corners(ours)
    if name.startswith(CUT):  # by alpha: then most triangles are still there, and the area is less
        missing = len(np.unique(np.concatenate([found, wanted]), axis=0)) - len(np.unique(found, axis=0))
        assert missing < 0.45 * len(wanted)
        areas = [trimesh.triangles.area(each.reshape(-1, 3, 3)).sum() for each in (found, wanted)]
        assert 0.5 < areas[0] / areas[1] < 1
    else:
        np.testing.assert_allclose(found, wanted, atol=1e-3)


def test_the_chess_boards_compressed_positions_are_as_far_apart_as_its_file_says(shared_data):
    """The accessors' own bounds were written before compression, by another program."""
    path = shared_data / "assets/chess-board/chess-board.glb"
    data = path.read_bytes()
    tree = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    bounds = [
        tree["accessors"][primitive["attributes"]["POSITION"]]
        for mesh in tree["meshes"]
        for primitive in mesh["primitives"]
    ]
    vertices = np.concatenate([part.vertices for part in read_parts(path, 10**6)])
    low, high = np.min([b["min"] for b in bounds], axis=0), np.max([b["max"] for b in bounds], axis=0)
    # Its root node turns z up into y up.
    np.testing.assert_allclose(vertices.min(axis=0), (low[0], low[2], -high[1]), atol=0.05)
    np.testing.assert_allclose(vertices.max(axis=0), (high[0], high[2], -low[1]), atol=0.05)


def test_the_chess_board_has_light_and_dark_squares_and_pieces(shared_data, variant):
    parts = load_model(shared_data / "assets/chess-board/chess-board.glb")
    geometry = Geometry([_of_model(part, 2, i) for i, part in enumerate(parts)])
    camera = Camera.look_at((0, -0.01, 3), (0, 0, 0), fov_deg=40, width=128, height=128)
    (view,) = gbuffers(geometry, [camera])
    middle = view.valid & (np.abs(view.position[..., :2]).max(axis=2) < 0.4)
    height = view.position[..., 2]
    board = np.median(height[middle])
    pieces = middle & (height > board + 0.02)
    assert 0.05 < pieces.sum() / middle.sum() < 0.7, "pieces stand on it"
    light = view.base_color[pieces].mean(axis=1)
    assert np.quantile(light, 0.9) > 5 * np.quantile(light, 0.1), "white ones and black ones"
    assert view.base_color[middle & ~pieces].std() > 0.01, "the board is no one colour"

"""Packed splats of other programs: in which frame they stand, and what their files say of them."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import plyfile
import pytest

from tron.gaussians.formats.packed import packed
from tron.gaussians.formats.spz import read_header
from tron.gaussians.harmonics import eval_sh, spread_directions
from tron.gaussians.reading import read_splats
from tron.gaussians.scene import GaussianScene
from tron.seeds import generator

COUNT = 30
NUMBERS = {"LUB": 3, "RUB": 4, "RDF": 6, "LUF": 7, "RFU": 12, "RBU": 16}
"""Of SPZ_ADOBE_coordinate_system (nianticlabs/spz, splat-types.h)."""


def plain(folder):
    """A PLY of 30 splats of degree 1, and its path."""
    rng = generator(0, "test", "field", "packed")
    names = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(9)), "opacity"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    rows = np.empty(COUNT, [(name, "<f4") for name in names])
    for name in names:
        rows[name] = rng.normal(size=COUNT) * (0.3 if name.startswith("f_") else 1)
    for k, name in enumerate(("scale_0", "scale_1", "scale_2")):
        rows[name] = (-2.0, -3.0, -6.0)[k]
    path = folder / "plain.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
    return path


def spz(path, number=None, flags=0):
    """The bytes of a PLY as .spz of version 3, with an extension that states a frame, or other flags."""
    content = bytearray(gzip.decompress(packed(path.read_bytes(), "spz")))
    content[14] |= flags | (2 if number is not None else 0)
    if number is not None:
        content += struct.pack("<II4s", 0xDEAD0001, 4, b"else") + struct.pack("<III", 0xADBE0003, 4, number)
    return gzip.compress(bytes(content))


def axes(letters):
    """(3, 3): where a file's x, y and z point, in a world that is right, down, front."""
    points = {
        "L": (-1, 0, 0),
        "R": (1, 0, 0),
        "U": (0, -1, 0),
        "D": (0, 1, 0),
        "F": (0, 0, 1),
        "B": (0, 0, -1),
    }
    return np.array([points[letter] for letter in letters], float).T


@pytest.mark.parametrize("frame", NUMBERS)
def test_a_frame_that_spz_states_is_followed(tmp_path, frame):
    wanted = GaussianScene.load(plain(tmp_path))
    (tmp_path / "a.spz").write_bytes(spz(tmp_path / "plain.ply", NUMBERS[frame]))
    found = GaussianScene.load(tmp_path / "a.spz")
    turn = axes(frame)
    np.testing.assert_allclose(found.means, wanted.means @ turn.T, atol=1e-3)
    assert np.abs((found.normals() * (wanted.normals() @ turn.T)).sum(1)).min() > 0.99
    assert (found.up.tolist(), found.up_guessed) == ([0, -1, 0], False)
    directions = spread_directions(20)
    shown = eval_sh(found.sh[:, None], directions[None] @ turn.T)
    np.testing.assert_allclose(shown, eval_sh(wanted.sh[:, None], directions[None]), atol=0.1)
    # Tangents as well: the discs are mirrored, not turned about their normals.
    wide, turned = found.tangents()[0], wanted.tangents()[0] @ turn.T
    first = found.log_scales[:, 0] > found.log_scales[:, 1]
    assert first.all()
    assert np.abs((wide * turned).sum(1)).min() > 0.98


def test_spz_that_states_none_is_y_up_with_a_line(tmp_path):
    (tmp_path / "a.spz").write_bytes(spz(plain(tmp_path)))
    found = read_splats(tmp_path / "a.spz")
    assert found["up_guessed"]
    np.testing.assert_array_equal(found["turn"] @ found["up"], (0, -1, 0))
    np.testing.assert_array_equal(found["up"], (0, 1, 0))  # in the file


@pytest.mark.parametrize(("flags", "projection"), [(0, "3dgs"), (1, "antialiased")])
def test_splats_that_were_learnt_antialiased_are_projected_so(tmp_path, flags, projection):
    (tmp_path / "a.spz").write_bytes(spz(plain(tmp_path), flags=flags))
    assert read_splats(tmp_path / "a.spz")["projection"] == projection


@pytest.mark.parametrize("cut", [0, 3, 20, 200])
def test_a_damaged_header_states_nothing(tmp_path, cut):
    whole = spz(plain(tmp_path), NUMBERS["RDF"])
    assert read_header(whole).stated
    assert not read_header(whole[:cut]).stated
    assert not read_header(spz(tmp_path / "plain.ply", 99)).stated


def test_extensions_of_version_4_stand_before_the_splats():
    record = struct.pack("<III", 0xADBE0003, 4, NUMBERS["RFU"])
    head = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 7, 0, 12, 3, 6, 32 + len(record))
    found = read_header(head + record + bytes(200))
    assert (found.frame, found.stated, found.antialiased) == ("RFU", True, True)
    elsewhere = struct.pack("<II", 1, 0xFFFFFFFF) + record  # a length that leads out of the file
    assert not read_header(head + elsewhere).stated


@pytest.mark.parametrize(("name", "stated"), [("v4_rdf_ext.spz", True), ("rdf_niantic_cli.spz", False)])
def test_the_files_of_the_field(shared_data, name, stated):
    path = shared_data / "field" / "spz-frame" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    scene = GaussianScene.load(path)
    assert scene.up_guessed != stated
    # The ground lies at y = 0; ball and box stand on it: at negative y where y points down.
    above = scene.means[:, 1] < -0.1
    assert above.mean() > 0.4 if stated else above.mean() == 0
    ground = np.abs(scene.means[:, 1]) < 1e-3
    np.testing.assert_allclose(np.abs(scene.means[ground][:, [0, 2]]).max(0), 2, atol=0.1)

"""PLY files: round trips, foreign files of every kind, and hostile ones."""

import dataclasses
import struct
import time

import numpy as np
import plyfile
import pytest
from scipy.spatial.transform import Rotation

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.estimation import MATERIAL
from tron.gaussians.ply import MATERIAL_PROPERTIES, header_comments
from tron.gaussians.scene import GaussianScene
from tron.seeds import generator

LAYOUT = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


@pytest.fixture
def scene(random_scene) -> GaussianScene:
    ids, up = np.arange(25) * 2**25 + 1, np.array([0.0, -1.0, 0.0])
    return random_scene(25, object_id=ids, kernel_degree=4, spacing=0.0123456789, up=up)


def rewrite(path, drop=(), change=None, text=False, order="<", comments=()):
    """Rewrite a PLY with plyfile alone: without some properties, with other values, in another encoding."""
    rows = plyfile.PlyData.read(str(path))["vertex"].data
    names = [name for name in rows.dtype.names if name not in drop]
    kept = np.empty(len(rows), [(name, rows.dtype[name].newbyteorder("=")) for name in names])
    for name in names:
        kept[name] = (change or {}).get(name, rows[name])
    del rows  # mapped from the file that is about to be overwritten
    element = plyfile.PlyElement.describe(kept, "vertex")
    plyfile.PlyData([element], text=text, byte_order=order, comments=list(comments)).write(str(path))


def test_a_scene_survives_the_file_to_the_last_bit(scene, tmp_path):
    scene.save(tmp_path / "a.ply")
    back = GaussianScene.load(tmp_path / "a.ply")
    for field in dataclasses.fields(GaussianScene):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(scene, field.name), field.name)
    back.save(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_bytes_are_those_a_3dgs_reader_expects(scene, tmp_path):
    scene.save(tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    properties = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    assert [name for _, name in properties[: len(LAYOUT)]] == LAYOUT
    assert {kind for kind, _ in properties[: len(LAYOUT)]} == {"float"}
    assert b"format binary_little_endian 1.0" in header
    stride = 4 * len(properties)
    assert len(body) == stride * len(scene)
    row = dict(zip(LAYOUT, struct.unpack_from(f"<{len(LAYOUT)}f", body, 3 * stride)))
    assert [row[k] for k in ("x", "y", "z")] == scene.means[3].tolist()
    assert [row[f"rot_{k}"] for k in range(4)] == scene.quats[3].tolist()
    assert row["f_rest_0"] == scene.sh[3, 1, 0]
    assert row["f_rest_14"] == scene.sh[3, 15, 0]
    assert row["f_rest_15"] == scene.sh[3, 1, 1]
    assert row["f_rest_44"] == scene.sh[3, 15, 2]
    assert row["opacity"] == scene.opacity_logits[3]
    assert [row["nx"], row["ny"], row["nz"]] == pytest.approx(scene.normals()[3].tolist())
    assert row["scale_2"] < min(row["scale_0"], row["scale_1"]) - 6


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, ">"), (False, "<")])
def test_every_encoding_gives_the_same_scene(scene, tmp_path, text, order):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, text=text, order=order)
    back = GaussianScene.load(path)
    np.testing.assert_allclose(back.means, scene.means, rtol=1e-6)
    np.testing.assert_allclose(back.sh, scene.sh, rtol=1e-6)
    np.testing.assert_array_equal(back.object_id, scene.object_id)


def test_a_plain_3dgs_file_gets_guessed_materials(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, drop=(*MATERIAL_PROPERTIES, "object_id"))
    back = GaussianScene.load(path)
    assert back.materials_guessed
    assert not back.oriented
    assert back.kernel_degree == 2
    mean = np.clip(scene.sh[:, 0] * 0.28209479177387814 + 0.5, 0, 1)
    np.testing.assert_allclose(back.base_color, srgb_to_linear(mean), atol=1e-6)
    assert (back.metallic == 0).all()
    assert (back.object_id == 0).all()
    assert 0 < back.spacing < 3


def test_infinite_opacities_are_opaque_and_absent_surfels_are_counted(scene, tmp_path, caplog):
    path = tmp_path / "a.ply"
    scene.save(path)
    logits = scene.opacity_logits.copy()
    logits[[3, 4]], logits[7], logits[[11, 24]] = np.inf, -np.inf, np.nan
    rewrite(path, change={"opacity": logits})
    back = GaussianScene.load(path)
    kept = np.setdiff1d(np.arange(len(scene)), [7, 11, 24])
    np.testing.assert_array_equal(back.means, scene.means[kept])
    np.testing.assert_array_equal(back.object_id, scene.object_id[kept])
    assert (back.opacities()[[3, 4]] > 0.9999).all()
    finite = np.setdiff1d(np.arange(len(kept)), [3, 4])
    np.testing.assert_array_equal(back.opacity_logits[finite], logits[kept][finite])
    (line,) = caplog.messages
    assert "2 infinite opacities taken as opaque, 3 surfels left out" in line


def test_a_file_without_a_single_opaque_surfel_is_refused(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, change={"opacity": np.full(len(scene), -np.inf, np.float32)})
    refuse(path, "no surfels")


@pytest.mark.parametrize(
    ("comments", "up", "guessed"),
    [
        ([], (0, -1, 0), True),
        (["Generated by Nerfstudio 1.1.5", "Vertical Axis: z"], (0, 0, 1), False),
        (["Vertical Axis: y"], (0, 1, 0), False),
        (["Vertical Axis: unknown"], (0, -1, 0), True),
        (["tron up 1.0 0.0 0.0"], (1, 0, 0), False),
    ],
)
def test_up_is_what_the_file_says_or_minus_y(scene, tmp_path, comments, up, guessed):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, comments=comments)
    back = GaussianScene.load(path)
    assert (back.up.tolist(), back.up_guessed) == (list(up), guessed)
    turn = Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix()
    back.rotated(turn).save(path)
    again = GaussianScene.load(path)  # a guess stays a guess, in the world as it now is
    np.testing.assert_allclose(again.up, turn @ up, atol=1e-12)
    assert again.up_guessed is guessed


@pytest.mark.parametrize("name", ["biker", "guitar"])
def test_real_scans_load_and_stand_upright(shared_data, name):
    scene = GaussianScene.load(shared_data / "splats" / f"{name}.ply")
    assert scene.opacities().max() < 1
    low, high = scene.bounds(0.01)
    assert (high - low).argmax() == np.abs(scene.up).argmax(), "taller than wide, along up"


def test_a_2dgs_file_with_two_scales_loads(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, drop=(*MATERIAL_PROPERTIES, "object_id", "scale_2"))
    back = GaussianScene.load(path)
    np.testing.assert_array_equal(back.log_scales, scene.log_scales)
    np.testing.assert_array_equal(back.quats, scene.quats)


def test_dropping_the_thin_axis_keeps_the_gaussian(scene, tmp_path):
    # Independent witness: the covariance R diag(s^2) R^T of the file, its smallest eigenvalue set to zero.
    path = tmp_path / "a.ply"
    scene.save(path)
    scales = generator(0, "test", "scales").uniform(-4, -2, (len(scene), 3)).astype(np.float32)
    quats = scene.quats * np.linspace(0.5, 3, len(scene), dtype=np.float32)[:, None]
    change = {f"scale_{k}": scales[:, k] for k in range(3)} | {f"rot_{k}": quats[:, k] for k in range(4)}
    rewrite(path, change=change)
    assert len(np.unique(scales.argmin(axis=1))) == 3
    back = GaussianScene.load(path)
    rotation = Rotation.from_quat(scene.quats, scalar_first=True).as_matrix()
    variances = np.exp(2 * scales.astype(np.float64))
    variances[np.arange(len(scene)), scales.argmin(axis=1)] = 0
    expected = np.einsum("mij,mj,mkj->mik", rotation, variances, rotation)
    ours = np.einsum(
        "mij,mj,mkj->mik", back.rotations()[:, :, :2], back.scales() ** 2, back.rotations()[:, :, :2]
    )
    np.testing.assert_allclose(ours, expected, atol=1e-8)
    np.testing.assert_allclose(np.linalg.det(back.rotations()), 1, atol=1e-5)


@pytest.mark.parametrize(("rest", "bands"), [(0, 0), (9, 3), (24, 8)])
def test_lower_degrees_fill_the_low_bands(scene, tmp_path, rest, bands):
    path = tmp_path / "a.ply"
    scene.save(path)
    values = {f"f_rest_{i}": np.full(len(scene), i, np.float32) for i in range(rest)}
    rewrite(path, drop=[f"f_rest_{i}" for i in range(rest, 45)], change=values)
    back = GaussianScene.load(path)
    assert (back.sh[:, bands + 1 :] == 0).all()
    if bands:
        np.testing.assert_array_equal(back.sh[0, 1 : bands + 1, 1], np.arange(bands, 2 * bands))


def refuse(path, words):
    started = time.process_time()
    with pytest.raises(TronError, match=words) as caught:
        GaussianScene.load(path)
    assert time.process_time() - started < 1
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_properties_are_named(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, drop=("opacity", "rot_2"))
    refuse(path, "lacks opacity, rot_2")


def test_half_a_set_of_materials_is_refused(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    rewrite(path, drop=("roughness",))
    refuse(path, "has base_color_0 but lacks roughness")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("roughness", np.nan, "roughness"),
        ("base_color_1", 7.0, r"base_color of 1 surfels is outside \[0, 1\]"),
    ],
)
def test_bad_values_are_refused(scene, tmp_path, name, value, words):
    path = tmp_path / "a.ply"
    scene.save(path)
    rows = plyfile.PlyData.read(str(path))["vertex"][name].copy()
    rows[5] = value
    rewrite(path, change={name: rows})
    refuse(path, words)


HEADER = "ply\nformat {format} 1.0\n{body}end_header\n"
FLOATS = "".join(f"property float {name}\n" for name in LAYOUT)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "an empty file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "not a PLY"),
        (
            HEADER.format(format="binary_little_endian", body=f"element vertex {10**12}\n"),
            "without properties",
        ),
        (HEADER.format(format="ascii", body=f"element vertex 0\n{FLOATS}"), "no surfels"),
        (HEADER.format(format="ascii", body="element face 0\nproperty float x\n"), "no vertex element"),
        (HEADER.format(format="purple", body=f"element vertex 0\n{FLOATS}"), "not a readable PLY"),
        (
            HEADER.format(format="ascii", body=f"element vertex 1\n{FLOATS}") + "pickle " * 62,
            "not a readable",
        ),
        (
            HEADER.format(format="ascii", body=f"comment tron spacing wide\nelement vertex 0\n{FLOATS}"),
            "does not hold finite numbers",
        ),
    ],
)
def test_files_without_surfels_are_refused_at_once(tmp_path, content, words):
    path = tmp_path / "hostile.ply"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refuse(path, words)


def test_truncated_and_missing_files_are_refused(scene, tmp_path):
    path = tmp_path / "a.ply"
    scene.save(path)
    path.write_bytes(path.read_bytes()[:-7])
    refuse(path, "cut short")
    refuse(tmp_path / "absent.ply", "cannot read")
    refuse(tmp_path, "cannot read")


def test_a_broken_scene_leaves_no_file(scene, tmp_path):
    scene.means[0] = np.nan
    with pytest.raises(TronError, match="means"):
        scene.save(tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_scene_names_the_material_that_it_is_drawn_with(scene, tmp_path):
    scene.save(tmp_path / "a.ply")
    assert f"tron material {MATERIAL}" in header_comments(tmp_path / "a.ply")
    GaussianScene.load(tmp_path / "a.ply")  # no number, as other comments of ours are

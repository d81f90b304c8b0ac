"""Splats under other names, in other numbers and with materials of other programs: read, or named."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import plyfile
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from tron.errors import TronError
from tron.gaussians.formats import gltf
from tron.gaussians.formats.registry import check_header
from tron.gaussians.formats.splats import Splats
from tron.gaussians.harmonics import dc_to_rgb
from tron.gaussians.scene import GaussianScene
from tron.seeds import generator

COUNT = 400
ROTATIONS = [f"rot_{k}" for k in range(4)]
SCALES = [f"scale_{k}" for k in range(3)]
COLORS = [f"f_dc_{k}" for k in range(3)]


def splats() -> dict[str, np.ndarray]:
    """A sheet of flat splats, about as wide as they are apart, as 3DGS stores them."""
    rng = generator(0, "test", "field", "stored values")
    columns = {"x": rng.uniform(-1, 1, COUNT), "y": rng.uniform(-1, 1, COUNT), "z": np.zeros(COUNT)}
    columns |= {name: rng.normal(size=COUNT) for name in COLORS}
    columns["opacity"] = logit(rng.uniform(0.05, 0.99, COUNT))
    columns |= {name: np.log(rng.uniform(0.02, 0.1, COUNT)) - 3 * (name == "scale_2") for name in SCALES}
    return columns | dict(zip(ROTATIONS, Rotation.random(COUNT, rng).as_quat(scalar_first=True).T))


def write(path: Path, columns: dict[str, np.ndarray], faces: int = 0) -> Path:
    rows = np.empty(
        COUNT, [(name, values.dtype if values.dtype == "u1" else "<f4") for name, values in columns.items()]
    )
    for name, values in columns.items():
        rows[name] = values
    elements = [plyfile.PlyElement.describe(rows, "vertex")]
    if faces:
        corners = np.empty(faces, [("vertex_indices", "i4", (3,))])
        corners["vertex_indices"] = 0
        elements.append(plyfile.PlyElement.describe(corners, "face"))
    plyfile.PlyData(elements, byte_order="<").write(str(path))
    return path


def require_same(found: GaussianScene, wanted: GaussianScene) -> None:
    for name in ("means", "log_scales", "opacity_logits", "quats"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-4)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-2)


def lengths(columns: dict) -> dict:
    return columns | {name: np.exp(columns[name]) for name in SCALES}


def opacities(columns: dict) -> dict:
    return columns | {"opacity": expit(columns["opacity"])}


def bytes_of_colors(columns: dict) -> dict:
    return columns | {name: np.round(255 * dc_to_rgb(columns[name]).clip(0, 1)) for name in COLORS}


def rgb(columns: dict) -> dict:
    named = dict(
        zip(("red", "green", "blue"), (bytes_of_colors(columns)[name].astype("u1") for name in COLORS))
    )
    return {name: values for name, values in columns.items() if name not in COLORS} | named


def prefixed(columns: dict) -> dict:
    return {name if name in "xyz" else f"scalar_{name}": values for name, values in columns.items()}


OTHERWISE = {
    "lengths": (lengths, "scales are lengths,"),
    "opacities": (opacities, "opacities lie in [0, 1],"),
    "lengths and opacities": (lambda columns: opacities(lengths(columns)), "lengths, opacities"),
    "bytes": (bytes_of_colors, "colours are bytes"),
    "all": (
        lambda columns: bytes_of_colors(opacities(lengths(columns))),
        "lengths, opacities lie in [0, 1], colours",
    ),
    "red green blue": (rgb, "red, green and blue"),
    "CloudCompare": (prefixed, ""),
    "CloudCompare's colours": (lambda columns: prefixed(columns) | rgb(columns), ""),
}


@pytest.mark.parametrize("kind", OTHERWISE)
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_numbers_and_names_of_others_are_read(tmp_path: Path, caplog, kind: str, size: float) -> None:
    """At every scale: in millimetres logarithms of widths are all positive, and are still logarithms."""
    caplog.set_level(logging.INFO)
    plain = splats()
    plain |= {axis: plain[axis] * size for axis in "xyz"} | {
        name: plain[name] + np.log(size) for name in SCALES
    }
    plain |= {name: plain[name].clip(-1.7, 1.7) for name in COLORS}  # what bytes hold
    wanted = GaussianScene.load(write(tmp_path / "plain.ply", plain))
    assert "not as 3DGS" not in caplog.text
    change, said = OTHERWISE[kind]
    if size == 1e-3 and "lengths" in kind + said:
        return  # exp of lengths so small is 1 everywhere: covered by the others
    path = write(tmp_path / "a.ply", change(plain))
    check_header(path)
    require_same(GaussianScene.load(path), wanted)
    assert said in caplog.text


def test_what_is_a_blur_however_it_is_read_is_refused(tmp_path: Path) -> None:
    columns = splats()
    columns |= {name: columns[name] + 8.0 for name in SCALES}
    with pytest.raises(TronError, match=r"all is one blur.*logarithms"):
        GaussianScene.load(write(tmp_path / "a.ply", columns))


def test_a_broken_splat_hides_nothing(tmp_path: Path) -> None:
    columns = opacities(lengths(splats()))
    columns["scale_0"][3], columns["scale_1"][4] = np.nan, np.inf
    found = GaussianScene.load(write(tmp_path / "a.ply", columns))
    assert len(found) == COUNT - 2
    assert found.scales().max() < 0.11


def test_equal_opacities_of_plain_scans_stay_logits(tmp_path: Path) -> None:
    columns = splats() | {"opacity": np.full(COUNT, 0.97)}
    assert GaussianScene.load(write(tmp_path / "a.ply", columns)).opacities()[0] == pytest.approx(expit(0.97))


@pytest.mark.parametrize("swapped", ["scales", "opacities", "both", "none"])
def test_gltf_that_holds_logarithms_is_read_with_a_line(
    tmp_path: Path, caplog, monkeypatch, swapped: str
) -> None:
    columns = splats()
    given = Splats(
        np.stack([columns[axis] for axis in "xyz"], 1),
        np.stack([columns[name] for name in ROTATIONS], 1),
        np.stack([columns[name] for name in SCALES], 1),
        columns["opacity"],
        np.stack([columns[name] for name in COLORS], 1)[:, None].repeat(16, 1),
    )
    with monkeypatch.context() as patch:
        if swapped in ("scales", "both"):
            patch.setattr(gltf.np, "exp", lambda values: values)
        if swapped in ("opacities", "both"):
            patch.setattr(gltf, "expit", lambda values: values)
        patch.setattr(gltf, "dc_to_rgb", lambda values: values * 0)
        with np.errstate(all="ignore"):
            content = gltf.write(given)
    (tmp_path / "a.glb").write_bytes(content)
    found = gltf.read(tmp_path / "a.glb")
    np.testing.assert_allclose(found.log_scales, given.log_scales, atol=1e-4)
    np.testing.assert_allclose(found.opacity_logits, given.opacity_logits, atol=1e-3)
    assert ("read as logarithms" in caplog.text) == (swapped in ("scales", "both"))
    assert ("read as logits" in caplog.text) == (swapped in ("opacities", "both"))


PROGRAMS = {
    "Relightable3DGaussian": ["base_color_0", "base_color_1", "base_color_2", "roughness", "incidents_dc_0"],
    "Ref-Gaussian": ["base_color_0", "base_color_1", "base_color_2", "roughness", "metallic", "ind_dc_0"],
    "GS-IR": ["normal_0", "albedo_0", "roughness", "metallic"],
    "3DGS-DR": ["refl_strength"],
    "the kind of GS-IR": ["albedo_0", "roughness"],
    "the kind of Relightable3DGaussian": ["base_color_0", "base_color_1", "base_color_2", "roughness"],
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_splats_with_materials_of_other_programs_are_plain_scans(
    tmp_path: Path, caplog, program: str
) -> None:
    plain = splats()
    wanted = GaussianScene.load(write(tmp_path / "plain.ply", plain))
    columns = plain | {name: np.linspace(-5, 5, COUNT) for name in PROGRAMS[program]}
    found = GaussianScene.load(write(tmp_path / "a.ply", columns))
    require_same(found, wanted)
    np.testing.assert_array_equal(found.base_color, wanted.base_color)
    assert found.materials_guessed
    assert program in caplog.text
    assert "read as a plain scan" in caplog.text


def test_gaussianshader_shows_its_diffuse_colours(tmp_path: Path, caplog) -> None:
    plain = splats()
    names = ["nx2", "roughness", "specular0", "specular1", "specular2", "f_rest_0", "f_rest_1", "f_rest_2"]
    found = GaussianScene.load(write(tmp_path / "a.ply", plain | {name: np.ones(COUNT) for name in names}))
    stored = np.stack([plain[name] for name in COLORS], 1)
    np.testing.assert_allclose(dc_to_rgb(found.sh[:, 0]), 1 / (1 + 3 * np.exp(-stored)), atol=1e-5)
    assert np.abs(found.sh[:, 1:]).max() == 0
    assert "GaussianShader" in caplog.text


def test_materials_that_tron_might_have_written_stay(tmp_path: Path) -> None:
    """Whole ones without another program's marks are taken at their word."""
    columns = splats() | {f"base_color_{k}": np.full(COUNT, 0.25 * (k + 1)) for k in range(3)}
    columns |= {"roughness": np.full(COUNT, 0.4), "metallic": np.zeros(COUNT)}
    found = GaussianScene.load(write(tmp_path / "a.ply", columns))
    np.testing.assert_allclose(found.base_color[0], (0.25, 0.5, 0.75))
    assert not found.materials_guessed


@pytest.mark.parametrize(("faces", "words"), [(3, "a mesh, not splats.*meshes="), (0, "a cloud of points")])
@pytest.mark.parametrize("colors", [True, False])
def test_meshes_and_points_are_called_that(tmp_path: Path, faces: int, words: str, colors: bool) -> None:
    columns = {axis: splats()[axis] for axis in "xyz"} | {"nx": np.zeros(COUNT)}
    if colors:
        columns |= {name: np.zeros(COUNT, "u1") for name in ("red", "green", "blue")}
    with pytest.raises(TronError, match=words):
        check_header(write(tmp_path / "a.ply", columns, faces))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("activated-ply/activated.ply", "scales are lengths, opacities lie in [0, 1]"),
        ("glb-logscale/logscale.glb", "read as logarithms"),
        ("other-names-ply/nerfstudio_rgb.ply", "red, green and blue"),
        ("relightable-ply/r3dg.ply", "materials of Relightable3DGaussian"),
        ("relightable-ply/refgaussian.ply", "materials of Ref-Gaussian"),
    ],
)
def test_the_files_of_the_field(shared_data, caplog, name: str, said: str) -> None:
    """All hold scene.py's world: ball, box and ground of splats 0.035 to 0.045 wide."""
    caplog.set_level(logging.INFO)
    path = shared_data / "field" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    scene = GaussianScene.load(path)
    assert said in caplog.text
    assert len(scene) in (917, 1834)
    widths = np.exp(scene.log_scales)
    assert np.minimum(abs(widths - 0.035), abs(widths - 0.045)).max() < 1e-5
    assert scene.opacities().min() > 0.96
    colors = np.unique(dc_to_rgb(scene.sh[:, 0]).round(2), axis=0)
    wanted = {(0.7, 0.7, 0.65), (0.35, 0.4, 0.35), (0.8, 0.15, 0.1), (0.1, 0.2, 0.8)}
    assert {tuple(round(float(value), 2) for value in color) for color in colors} == wanted

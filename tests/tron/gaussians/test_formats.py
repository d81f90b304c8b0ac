"""Splats as glTF, USD and checkpoints: round trips, files by other hands, and what is refused."""

# usd-core has no types.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
import trimesh

from tron.apps.export import MESHES
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.framing import Y_UP, upright
from tron.gaussians.edit import KERNEL_WIDTHS
from tron.gaussians.formats.registry import READ, WRITTEN, check_header, refuse_foreign
from tron.gaussians.harmonics import dc_to_rgb, eval_sh, spread_directions
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_points, write_splats

SUFFIXES = (".glb", ".usda", ".usdc", ".usdz")
SPLAT_TRANSFORM = shutil.which("splat-transform")


def same(found: GaussianScene, wanted: GaussianScene, atol: float = 2e-5) -> None:
    """Both look alike: centres, disks, opacities, and colours from six sides."""
    np.testing.assert_allclose(found.means, wanted.means, atol=atol)
    np.testing.assert_allclose(np.sort(found.log_scales), np.sort(wanted.log_scales), atol=1e-3)
    np.testing.assert_allclose(np.exp(found.log_thickness), np.exp(wanted.log_thickness), atol=3e-4)
    np.testing.assert_allclose(np.abs((found.normals() * wanted.normals()).sum(1)), 1, atol=1e-3)
    np.testing.assert_allclose(found.opacities(), wanted.opacities(), atol=1e-5)
    for direction in spread_directions(6):
        seen = np.broadcast_to(direction, found.means.shape)
        np.testing.assert_allclose(eval_sh(found.sh, seen), eval_sh(wanted.sh, seen), atol=1e-4)


def tilted(random_scene: Callable[..., GaussianScene]) -> GaussianScene:
    up = np.array([0.48, -0.6, 0.64])
    return random_scene(60, kernel_degree=2, up=up)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_scene_comes_back_upright(random_scene, tmp_path: Path, suffix: str) -> None:
    scene = tilted(random_scene)
    write_splats(tmp_path / f"a{suffix}", scene)
    found = GaussianScene.load(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(found.up, [0, 1, 0])
    assert not found.up_guessed
    same(found, scene.rotated(Y_UP @ upright(scene.up)))
    same(found.upright(), scene.upright())


def test_kernels_of_degree_4_are_widened(random_scene, tmp_path: Path) -> None:
    scene = random_scene(20, kernel_degree=4)
    write_splats(tmp_path / "a.glb", scene)
    found = GaussianScene.load(tmp_path / "a.glb")
    np.testing.assert_allclose(
        np.sort(found.log_scales), np.sort(scene.log_scales) + np.log(KERNEL_WIDTHS), atol=1e-3
    )


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="npm install -g @playcanvas/splat-transform")
def test_gltf_of_splat_transform_is_the_ply_turned_half_about_z(random_scene, tmp_path: Path) -> None:
    scene = tilted(random_scene)
    write_splats(tmp_path / "a.ply", scene)
    assert SPLAT_TRANSFORM is not None
    subprocess.run([SPLAT_TRANSFORM, tmp_path / "a.ply", tmp_path / "b.glb"], check=True, capture_output=True)
    same(GaussianScene.load(tmp_path / "b.glb"), scene.rotated(np.diag([-1.0, -1, 1])))


def test_others_see_points_in_mean_colours(random_scene, tmp_path: Path) -> None:
    """trimesh knows nothing of the extension."""
    scene = tilted(random_scene)
    write_splats(tmp_path / "a.glb", scene)
    (points,) = trimesh.load_scene(tmp_path / "a.glb").geometry.values()
    assert isinstance(points, trimesh.PointCloud)
    turned = scene.rotated(Y_UP @ upright(scene.up))
    np.testing.assert_allclose(points.vertices, turned.means, atol=1e-5)
    shown = linear_to_srgb(np.asarray(points.colors)[:, :3] / 255)
    np.testing.assert_allclose(shown, np.clip(dc_to_rgb(turned.sh[:, 0]), 0, 1), atol=0.04)


def glb(path: Path, nodes: list[dict], extension: dict | None = None, extra: dict | None = None) -> Path:
    """A file of one splat on the x axis, tall along z, as the specification says; its nodes are given."""
    values = {
        "POSITION": [1.0, 0, 0],
        "KHR_gaussian_splatting:ROTATION": [0.0, 0, 0, 1],
        "KHR_gaussian_splatting:SCALE": [0.25, 0.125, 1.0],
        "KHR_gaussian_splatting:OPACITY": [0.75],
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": [0.1, 0.2, 0.3],
    }
    binary, views, accessors = b"", [], []
    for each in values.values():
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": 4 * len(each)})
        kind = "SCALAR" if len(each) == 1 else f"VEC{len(each)}"
        accessors.append({"bufferView": len(accessors), "componentType": 5126, "count": 1, "type": kind})
        binary += struct.pack(f"<{len(each)}f", *each)
    says = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | (extension or {})
    primitive = {"attributes": {name: k for k, name in enumerate(values)}, "mode": 0}
    primitive["extensions"] = {"KHR_gaussian_splatting": says}
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes,
        "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    text = json.dumps(tree | (extra or {})).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(binary), 0x004E4942) + binary)
    return path


def test_nodes_move_their_splats(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    quarter_about_z = [0, 0, half, half]
    nodes = [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "rotation": quarter_about_z}]
    nodes[1]["translation"] = [0, 0, 5]
    scene = GaussianScene.load(glb(tmp_path / "a.glb", nodes))
    np.testing.assert_allclose(scene.means, [[0, 2, 10]], atol=1e-6)
    np.testing.assert_allclose(np.sort(np.exp(scene.log_scales)), [[0.5, 2]], rtol=1e-6)
    np.testing.assert_allclose(np.abs(scene.normals()), [[1, 0, 0]], atol=1e-6)  # y, the thinnest, went to x
    np.testing.assert_allclose(scene.opacities(), 0.75, atol=1e-6)
    np.testing.assert_allclose(scene.sh[0, 0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(scene.up, [0, 1, 0])


ONE = [{"mesh": 0}]


@pytest.mark.parametrize(
    ("nodes", "extension", "extra", "words"),
    [
        ([{"mesh": 0, "scale": [1, 2, 1]}], None, None, "stretched"),
        ([{"mesh": 0, "scale": [-1, 1, 1]}], None, None, "mirrored"),
        (ONE, {"kernel": "box"}, None, "kernel 'box'"),
        (ONE, {"colorSpace": "lin_rec709_display"}, None, "lin_rec709_display"),
        (ONE, {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {}}}, None, "spz_2"),
        (ONE, None, {"extensionsRequired": ["EXT_other"]}, "EXT_other"),
        ([{"children": [0]}], None, None, "deep"),
        (ONE, None, {"scenes": [{"nodes": []}]}, "holds no splats"),
        (ONE, None, {"meshes": []}, "holds no splats"),
        (ONE, None, {"accessors": [{"bufferView": 0, "count": 1}] * 5}, "cannot be read, KeyError"),
        (ONE, None, {"buffers": [{"byteLength": 4, "uri": "../../etc/passwd"}]}, "outside its folder"),
    ],
)
def test_what_is_no_splat_of_ours_costs_a_line(tmp_path, nodes, extension, extra, words) -> None:
    path = glb(tmp_path / "a.glb", nodes, extension, extra)
    with pytest.raises(TronError, match=words) as refusal:
        GaussianScene.load(path)
    assert str(path) in str(refusal.value)


USDA = """#usda 1.0
(
    upAxis = "Z"
)
def Xform "world" {
    double3 xformOp:translate = (10, 0, 0)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def ParticleField3DGaussianSplat "splats" {
        point3f[] positions = [(1, 2, 3)]
        quatf[] orientations = [(0.70710678, 0, 0, 0.70710678)]
        float3[] scales = [(0.5, 0.25, 0.125)]
        float[] opacities = [0.75]
        int radiance:sphericalHarmonicsDegree = 0
        float3[] radiance:sphericalHarmonicsCoefficients = [(0.1, 0.2, 0.3)]
    }
}
"""


def test_usd_by_hand_is_read_where_it_stands(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(USDA)
    scene = GaussianScene.load(tmp_path / "a.usda")
    np.testing.assert_allclose(scene.means, [[12, 4, 6]], atol=1e-6)
    np.testing.assert_allclose(np.exp(scene.log_scales), [[1, 0.5]], rtol=1e-5)
    u, v = scene.tangents()
    np.testing.assert_allclose(np.abs(np.stack([u[0], v[0]])), [[0, 1, 0], [1, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(scene.sh[0, 0], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_array_equal(scene.up, [0, 0, 1])


def test_another_reader_of_usd_finds_our_splats(random_scene, tmp_path: Path) -> None:
    from pxr import Usd, UsdVol

    scene = tilted(random_scene)
    write_splats(tmp_path / "a.usdz", scene)
    turned = scene.rotated(Y_UP @ upright(scene.up))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    np.testing.assert_allclose(np.array(field.GetPositionsAttr().Get()), turned.means, atol=1e-5)
    first = field.GetOrientationsAttr().Get()[0]
    xyzw = [*first.GetImaginary(), first.GetReal()]
    np.testing.assert_allclose(xyzw, turned.quats[0][[1, 2, 3, 0]], atol=1e-6)
    coefficients = field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()
    np.testing.assert_allclose(np.array(coefficients).reshape(-1, 16, 3), turned.sh, atol=1e-5)


@pytest.mark.parametrize("arc", ["references", "payload", "subLayers"])
def test_usd_that_refers_to_elsewhere_is_refused(tmp_path: Path, arc: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    for folder in (tmp_path, inside):
        (folder / "other.usda").write_text(
            USDA.replace('upAxis = "Z"', 'upAxis = "Z"\n    defaultPrim = "world"')
        )
    for name, fine in (("other.usda", True), ("../other.usda", False), (f"{tmp_path}/other.usda", False)):
        body = f'def "a" ({arc} = @{name}@) {{}}'
        if arc == "subLayers":
            body = f"(\n    subLayers = [@{name}@]\n)"
        (inside / "a.usda").write_text(f"#usda 1.0\n{body}\n")
        if fine:
            assert len(GaussianScene.load(inside / "a.usda")) == 1
            continue
        with pytest.raises(TronError, match="outside of it"):
            GaussianScene.load(inside / "a.usda")


def usdz(path: Path, layers: dict[str, str], kind: int = zipfile.ZIP_STORED) -> Path:
    """A package whose files begin at multiples of 64 bytes, as USDZ asks for."""
    with zipfile.ZipFile(path, "w", kind) as package:
        for name, content in layers.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type = kind
            assert package.fp is not None
            pad = -(package.fp.tell() + 30 + len(name) + 4) % 64
            entry.extra = struct.pack("<HH", 0x1986, pad) + b"\0" * pad
            package.writestr(entry, content)
    return path


def test_usdz_with_references_outside_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.usda").write_text(USDA)
    whole = {"a.usda": "#usda 1.0\n(\n    subLayers = [@b.usda@]\n)\n", "b.usda": USDA}
    assert len(GaussianScene.load(usdz(tmp_path / "whole.usdz", whole))) == 1
    mesh = '#usda 1.0\ndef Mesh "ball"\n{\n    custom asset picture = @paint.png@\n}\n'
    with pytest.raises(TronError, match=r"holds no splats .*, but a mesh"):
        GaussianScene.load(usdz(tmp_path / "mesh.usdz", {"mesh.usda": mesh, "paint.png": "no layer"}))
    for name in ("../other.usda", f"{tmp_path}/other.usda"):
        for layer in ("a.usda", "b.usda"):
            layers = whole | {layer: f"#usda 1.0\n(\n    subLayers = [@b.usda@, @{name}@]\n)\n"}
            with pytest.raises(TronError, match="outside of it"):
                GaussianScene.load(usdz(tmp_path / "a.usdz", layers))
    with pytest.raises(TronError, match="compressed, which USDZ forbids"):
        GaussianScene.load(usdz(tmp_path / "z.usdz", whole, zipfile.ZIP_DEFLATED))


@pytest.mark.parametrize("suffix", (".glb", ".usdc", ".usdz"))
def test_damaged_files_cost_a_line(random_scene, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_splats(path, tilted(random_scene))
    content = path.read_bytes()
    for damaged in (b"", content[:3], content[: len(content) // 2], b"no splats at all, but some text"):
        path.write_bytes(damaged)
        with pytest.raises(TronError) as refusal:
            GaussianScene.load(path)
        assert str(path) in str(refusal.value)
        assert "\n" not in str(refusal.value)


def layouts(scene: GaussianScene) -> dict[str, object]:
    """What trainings save of a scene."""
    thin = np.maximum(scene.log_thickness, -12)[:, None]
    arrays = {
        "means": scene.means, "scales": np.concatenate([scene.log_scales, thin], axis=1),
        "quats": 3 * scene.quats, "opacities": scene.opacity_logits,
    }  # fmt: skip
    held = {name: torch.nn.Parameter(torch.from_numpy(each.copy())) for name, each in arrays.items()}
    dc, rest = (torch.from_numpy(each.copy()) for each in (scene.sh[:, :1], scene.sh[:, 1:]))
    column = held["opacities"][:, None].detach()
    splatfacto = held | {"features_dc": dc[:, 0], "features_rest": rest, "opacities": column}
    grut = {"positions": held["means"], "rotation": held["quats"], "scale": held["scales"], "density": column}
    grut |= {
        "features_albedo": dc[:, 0],
        "features_specular": rest.reshape(len(scene), -1),
        "n_active_features": 3,
    }
    own = (3, held["means"], dc, rest, held["scales"], held["quats"], column, *[torch.zeros(1)] * 3, {}, 1.5)
    return {
        "gsplat": {"step": 7, "splats": held | {"sh0": dc, "shN": rest}},
        "splatfacto": {"pipeline": {f"_model.gauss_params.{key}": each for key, each in splatfacto.items()}},
        "old splatfacto": {"pipeline": {f"_model.{key}": each for key, each in splatfacto.items()}},
        "3dgrut": grut | {"config": {"render": "3dgut"}},
        "3dgs": (own, 30_000),
    }


@pytest.mark.parametrize("kind", ["gsplat", "splatfacto", "old splatfacto", "3dgrut", "3dgs"])
def test_checkpoints_hold_what_was_trained(random_scene, tmp_path: Path, kind: str) -> None:
    scene = tilted(random_scene)
    path = tmp_path / "a.ckpt"
    torch.save(layouts(scene)[kind], path)
    found = GaussianScene.load(path)
    same(found, scene)
    np.testing.assert_array_equal(found.up, [0, -1, 0] if "3dg" in kind else [0, 0, 1])
    assert found.up_guessed is ("3dg" in kind)


class Shell:
    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self):
        return os.system, (f"touch {self.made}",)


def test_nothing_in_a_checkpoint_is_run(random_scene, tmp_path: Path) -> None:
    held = layouts(tilted(random_scene))["gsplat"]
    assert isinstance(held, dict)
    torch.save(held | {"more": Shell(tmp_path / "made")}, tmp_path / "a.pt")
    with pytest.raises(TronError, match="only weights are read"):
        GaussianScene.load(tmp_path / "a.pt")
    assert not (tmp_path / "made").exists()


def test_a_view_larger_than_its_file_is_refused(random_scene, tmp_path: Path) -> None:
    held = layouts(tilted(random_scene))["gsplat"]
    assert isinstance(held, dict)
    held["splats"]["means"] = torch.zeros(1, 3).expand(10**11, 3)
    torch.save(held, tmp_path / "a.pt")
    with pytest.raises(TronError, match="larger than the file"):
        GaussianScene.load(tmp_path / "a.pt")


@pytest.mark.parametrize("held", [{"state_dict": {}}, {"pipeline": {"field": torch.zeros(3)}}, [1, 2]])
def test_other_checkpoints_cost_a_line_with_a_way_out(tmp_path: Path, held: object) -> None:
    torch.save(held, tmp_path / "a.pth")
    refuse_foreign(tmp_path / "a.pth")
    check_header(tmp_path / "a.pth")
    with pytest.raises(TronError, match="checkpoint"):
        GaussianScene.load(tmp_path / "a.pth")


def test_points_stand_on_the_map_in_their_colours(random_scene, tmp_path: Path) -> None:
    scene = tilted(random_scene)
    scene.opacity_logits[:] = np.resize([-9, 0], len(scene))
    scene.offset = np.array([500_000.25, 5_400_000.5, 100])
    assert write_points(tmp_path / "a.ply", scene) == 30
    rows = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert rows["x"].dtype == np.float64
    cloud = trimesh.load(tmp_path / "a.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_allclose(cloud.vertices, scene.means[1::2] + scene.offset, atol=1e-6)
    shown = np.clip(dc_to_rgb(scene.sh[1::2, 0]), 0, 1)
    np.testing.assert_allclose(np.asarray(cloud.colors)[:, :3] / 255, shown, atol=0.003)


def test_the_page_of_formats_has_every_suffix(pytestconfig: pytest.Config) -> None:
    rows = (pytestconfig.rootpath / "docs/guides/formats.md").read_text().splitlines()
    cells = [row.split("|")[1:4] for row in rows if row.startswith("| `")]
    for column, known in ((1, set(READ)), (2, {*WRITTEN, *MESHES})):
        said = {
            suffix
            for row in cells
            if row[column].strip() not in ("no", "") and "refused" not in row[column]
            for suffix in re.findall(r"`(\.\w+)`", row[0] if "yes" in row[column] else row[column])
        }
        assert known <= said, known - said

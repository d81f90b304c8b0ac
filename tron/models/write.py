"""A part as a file with its textures inside: .glb of glTF, .usdz of USD."""

# usd-core has no types.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from trimesh import Trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from tron.color import linear_to_srgb
from tron.framing import Y_UP
from tron.io.optional import usd
from tron.models.parts import Part
from tron.storage import write_atomic


def write_glb(path: Path, part: Part) -> None:
    """Write a part that has one image each of base color, roughness and metallic, of emission if it glows.

    Args:
        path: the file.
        part: z up. Its base color is stored as sRGB, roughness as green and metallic as blue, of 8 bits;
            emission as sRGB, a share of its highest value, which the strength of the material is.

    Raises:
        TronError: the file cannot be written.
    """
    assert part.uv is not None
    surface = np.zeros_like(part.base_color)
    surface[..., 1], surface[..., 2] = part.roughness, part.metallic
    material = PBRMaterial(
        baseColorTexture=_image(linear_to_srgb(part.base_color)), metallicRoughnessTexture=_image(surface),
        metallicFactor=1.0, roughnessFactor=1.0,
    )  # fmt: skip
    share, highest = _glow(part)
    if highest > 0:
        material.emissiveTexture, material.emissiveFactor = _image(share), np.ones(3)

    def strengthen(tree: dict[str, Any]) -> None:
        name = "KHR_materials_emissive_strength"
        for each in tree["materials"] if highest > 0 else ():
            each["extensions"] = {name: {"emissiveStrength": highest}}
            tree["extensionsUsed"] = [name]

    uv = np.stack([part.uv[:, 0], 1 - part.uv[:, 1]], axis=1)  # trimesh counts v from the bottom
    mesh = Trimesh(
        part.vertices @ Y_UP.T, part.faces, vertex_normals=part.normals @ Y_UP.T,
        visual=TextureVisuals(uv, material=material), process=False,
    )  # fmt: skip
    content = mesh.export(file_type="glb", include_normals=True, tree_postprocessor=strengthen)
    assert isinstance(content, bytes)
    write_atomic(path, content)


def write_usdz(path: Path, part: Part) -> None:
    """Write what :func:`write_glb` does as a USDZ with UsdPreviewSurface; y up, a unit is a metre.

    Raises:
        TronError: usd-core is not installed, or the file cannot be written.
    """
    usd(str(path))
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

    assert part.uv is not None
    kinds = Sdf.ValueTypeNames
    with tempfile.TemporaryDirectory(prefix="tron-") as folder:
        layer = Path(folder) / "mesh.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/scene")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/scene/mesh")
        vertices = (part.vertices @ Y_UP.T).astype(np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.faces.astype(np.int32).ravel()))
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy((part.normals @ Y_UP.T).astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        uv = np.stack([part.uv[:, 0], 1 - part.uv[:, 1]], axis=1).astype(np.float32)  # v from the bottom
        coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", kinds.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        coordinates.Set(Vt.Vec2fArray.FromNumpy(uv))

        material = UsdShade.Material.Define(stage, "/scene/material")
        surface = UsdShade.Shader.Define(stage, "/scene/material/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        reader = UsdShade.Shader.Define(stage, "/scene/material/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set("st")
        found = reader.CreateOutput("result", kinds.Float2)
        stored = {
            "diffuseColor": ("base_color", linear_to_srgb(part.base_color), "sRGB", "rgb", kinds.Color3f),
            "roughness": ("roughness", part.roughness, "raw", "r", kinds.Float),
            "metallic": ("metallic", part.metallic, "raw", "r", kinds.Float),
        }
        share, highest = _glow(part)
        if highest > 0:
            stored["emissiveColor"] = ("emission", share, "sRGB", "rgb", kinds.Color3f)
        for name, (file, values, space, channels, kind) in stored.items():
            _image(np.asarray(values)).save(Path(folder) / f"{file}.png")
            texture = UsdShade.Shader.Define(stage, f"/scene/material/{file}")
            texture.CreateIdAttr("UsdUVTexture")
            texture.CreateInput("file", kinds.Asset).Set(f"./{file}.png")
            texture.CreateInput("sourceColorSpace", kinds.Token).Set(space)
            texture.CreateInput("fallback", kinds.Float4).Set(Gf.Vec4f(0.5, 0.5, 0.5, 1))
            if file == "emission":
                texture.CreateInput("scale", kinds.Float4).Set(Gf.Vec4f(highest))
            texture.CreateInput("st", kinds.Float2).ConnectToSource(found)
            output = texture.CreateOutput(channels, kinds.Float3 if channels == "rgb" else kinds.Float)
            surface.CreateInput(name, kind).ConnectToSource(output)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
        stage.GetRootLayer().Save()
        package = Path(folder) / "mesh.usdz"
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package))
        write_atomic(path, package.read_bytes())


def _glow(part: Part) -> tuple[np.ndarray, float]:
    """(h, w, 3) what a part emits over its highest value, sRGB, and that value; 0 where nothing glows."""
    emission = np.zeros((1, 1, 3)) if part.emission is None else part.emission
    highest = float(emission.max())
    return linear_to_srgb(emission / (highest or 1.0)), highest


def _image(values: np.ndarray) -> Image.Image:
    return Image.fromarray((np.clip(values, 0, 1) * 255).round().astype(np.uint8))

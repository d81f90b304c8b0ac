"""glTF files: what accessors, extensions and materials mean by the specification arrives in the parts."""

# pyright: reportCallIssue=false, reportOptionalSubscript=false, reportIndexIssue=false
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false
# pyright: reportAttributeAccessIssue=false

import base64
import io
import struct
import zlib

import DracoPy
import numpy as np
import pyarrow
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.gltf_document import APPROXIMATED, HONOURED, IGNORED
from tron.models.gltf.materials import decode_image, metallic_of
from tron.models.gltf.meshes import read_parts
from tron.models.load import load_model
from tron.seeds import generator

POSITIONS = np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], np.float32)
NORMALS = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)

# 16 x 16, red, green / blue, white quarters of 200 / 255; written by another library (alktx2 0.1.7).
KTX2 = {
    "etc1s": (
        "q0tUWCAyMLsNChoKAAAAAAEAAAAQAAAAEAAAAAAAAAAAAAAAAQAAAAEAAAABAAAAaAAAACwAAACUAAAAJAAAALgAAAAAAAAA"
        "jQAAAAAAAABFAQAAAAAAAAQAAAAAAAAAAAAAAAAAAAAsAAAAAAAAAAIAKACjAQIAAwMAAAgAAAAAAAAAAAA/AAAAAAAAAAAA"
        "/////x8AAABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuMTAAAAQAAgAtAAAACQAAAC8AAAAAAAAAAAAAAAAAAAAEAAAA"
        "AAAAAAAAAAAawEQAAAAAAABiQwIwAwAAAAAAgKwEYAqAAAAAAAiilQLABAAAAAAAAAJI3AGsqqqqUlVVVQUUwEQAAAAAAAAS"
        "gQCYAQAAAAAAQMIQECVgAAAAEDYukUQgyhGAGQAAAAAAACQBAQjIYQU="
    ),
    "uastc": (
        "q0tUWCAyMLsNChoKAAAAAAEAAAAQAAAAEAAAAAAAAAAAAAAAAQAAAAEAAAAAAAAAaAAAACwAAACUAAAALAAAAAAAAAAAAAAA"
        "AAAAAAAAAADAAAAAAAAAAAABAAAAAAAAAAEAAAAAAAAsAAAAAAAAAAIAKACmAQIAAwMAABAAAAAAAAAAAAB/AAAAAAAAAAAA"
        "/////x8AAABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuMTAAAAQAAAB/fwAAFxkA4P/zAAAAAAAAAAAAABcZAOD/8wAA"
        "AAAAAAAAAAAXABng/wMeAAAAAAAAAAAAFwAZ4P8DHgAAAAAAAAAAABcZAOD/8wAAAAAAAAAAAAAXGQDg//MAAAAAAAAAAAAA"
        "FwAZ4P8DHgAAAAAAAAAAABcAGeD/Ax4AAAAAAAAAAAAXAAD5/wPAAwAAAAAAAAAAFwAA+f8DwAMAAAAAAAAAABcZGfnfXGsB"
        "AAAAAAAAAAAXGRn531xrAQAAAAAAAAAAFwAA+f8DwAMAAAAAAAAAABcAAPn/A8ADAAAAAAAAAAAXGRn531xrAQAAAAAAAAAA"
        "FxkZ+d9cawEAAAAAAAAAAA=="
    ),
}


def mesh(**primitive):
    return {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | primitive]}]}


def card(material=None, attributes=None, **tree):
    """A tree of accessors 0 to 3: positions, indices, normals, texture coordinates."""
    names = {"POSITION": 0, "NORMAL": 2, "TEXCOORD_0": 3} | (attributes or {})
    return mesh(attributes=names, material=0) | {"materials": [material or {}]} | tree


CARD = [POSITIONS, FACES, NORMALS, UV]


def encoded(pixels, kind="PNG", **options):
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(buffer, kind, **options)
    return buffer.getvalue()


def textured(*sources, first=4, **texture):
    """Images in the buffer views from ``first`` on, and a texture of each."""
    images = [{"bufferView": first + i, "mimeType": "image/png"} for i in range(len(sources))]
    return {"images": images, "textures": [{"source": i} | texture for i in range(len(sources))]}


@pytest.fixture
def quarters():
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:8, :8, 0] = pixels[:8, 8:, 1] = pixels[8:, :8, 2] = pixels[8:, 8:] = 200
    return pixels


def read(path):
    return read_parts(path, 1000)


def one(path):
    (part,) = read(path)
    return part


def test_the_same_mesh_with_and_without_draco(tmp_path, write_glb):
    ball = trimesh.creation.icosphere(2)
    points = np.asarray(ball.vertices, np.float64)
    normals = np.asarray(ball.vertex_normals, np.float64)
    uv = np.column_stack([points[:, 0], points[:, 1]]) * 0.5 + 0.5
    faces = np.asarray(ball.faces, np.uint32)
    bits = 20
    blob = DracoPy.encode(
        points, faces, normals=normals, tex_coord=uv, preserve_order=True, quantization_bits=bits
    )
    ids = {a["attribute_type"]: a["unique_id"] for a in DracoPy.decode(blob).attributes}
    attributes = {"POSITION": 0, "NORMAL": 2, "TEXCOORD_0": 3}
    arrays = [a.astype(np.float32) for a in (points, normals, uv)]
    blobs = [arrays[0], faces.reshape(-1), arrays[1], arrays[2]]
    picture = encoded(np.full((4, 4, 3), 9))
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    plain = one(write_glb(tmp_path / "plain.glb", card(material, **textured(picture)), [*blobs, picture]))

    kind = DracoPy.AttributeType
    names = {"POSITION": kind.POSITION, "NORMAL": kind.NORMAL, "TEXCOORD_0": kind.TEX_COORD}
    packed = {"bufferView": 1, "attributes": {name: ids[number] for name, number in names.items()}}
    counts = [len(points), faces.size, len(points), len(points)]
    kinds = [("VEC3", 5126), ("SCALAR", 5125), ("VEC3", 5126), ("VEC2", 5126)]
    tree = mesh(attributes=attributes, material=0, extensions={"KHR_draco_mesh_compression": packed})
    tree |= {"materials": [material]} | textured(picture, first=0)
    tree["accessors"] = [{"count": n, "type": t, "componentType": c} for n, (t, c) in zip(counts, kinds)]
    tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    draco = one(write_glb(tmp_path / "draco.glb", tree, [picture, blob]))
    np.testing.assert_array_equal(draco.faces, plain.faces)
    np.testing.assert_allclose(draco.vertices, plain.vertices, atol=2.0 / 2**bits)
    np.testing.assert_allclose(draco.uv, plain.uv, atol=2.0 / 2**bits)
    assert np.degrees(np.arccos(np.clip((draco.normals * plain.normals).sum(axis=1), -1, 1))).max() < 1.0

    swapped = {"bufferView": 1, "attributes": packed["attributes"] | {"NORMAL": ids[kind.POSITION]}}
    tree["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"] = swapped
    other = one(write_glb(tmp_path / "swapped.glb", tree, [picture, blob]))
    np.testing.assert_allclose(other.normals, draco.vertices, atol=1e-6)  # the ids decide, not the kinds


def test_sparse_accessors_change_what_they_name(tmp_path, write_glb):
    def written(where, kind):
        sparse = {
            "count": 1,
            "indices": {"bufferView": 2, "componentType": kind},
            "values": {"bufferView": 3},
        }
        accessors = [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4, "sparse": sparse},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        ]
        blobs = [POSITIONS, FACES, where, np.array([[1, 5, 0]], np.float32)]
        return write_glb(tmp_path / "s.glb", mesh() | {"accessors": accessors}, blobs)

    expected = POSITIONS.copy()
    expected[2] = (1, 5, 0)
    np.testing.assert_array_equal(one(written(np.array([2], np.uint16), 5123)).vertices, expected[FACES])
    for where, kind in ((np.array([-1], np.int8), 5120), (np.array([1], np.float32), 5126)):
        with pytest.raises(TronError, match="indices that are not whole numbers"):
            read(written(where, kind))
    with pytest.raises(TronError, match="out of bounds"):
        load_model(written(np.array([4], np.uint16), 5123))


def test_points_are_no_triangles(tmp_path, write_glb):
    """A cloud of more points than triangles are allowed is left out, as a small one is."""
    tree = mesh()
    tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": 2}, "mode": 0})
    points = generator(0, "cloud").normal(size=(5000, 3)).astype(np.float32)
    assert len(one(write_glb(tmp_path / "p.glb", tree, [POSITIONS, FACES, points])).faces) == 2


@pytest.mark.parametrize(
    "material",
    [
        {"pbrMetallicRoughness": {"roughnessFactor": float("nan")}},
        {"pbrMetallicRoughness": {"metallicFactor": float("inf")}},
        {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1]}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"glossinessFactor": float("nan")}}},
        {"alphaMode": "MASK", "alphaCutoff": float("nan")},
    ],
)
def test_factors_that_are_no_numbers_are_refused(tmp_path, write_glb, material):
    with pytest.raises(TronError, match=r"finite.*n\.glb"):
        load_model(write_glb(tmp_path / "n.glb", card(material), CARD))


def test_factors_are_clamped(tmp_path, write_glb):
    factors = {"roughnessFactor": 1.5, "metallicFactor": -0.1, "baseColorFactor": [2, 0.5, -1, 1]}
    part = one(write_glb(tmp_path / "f.glb", card({"pbrMetallicRoughness": factors}), CARD))
    assert (part.roughness, part.metallic) == (1.0, 0.0)
    np.testing.assert_array_equal(part.base_color, (1, 0.5, 0))


def test_quantised_and_interleaved_attributes_are_what_they_stand_for(tmp_path, write_glb):
    rows = np.zeros(4, [("position", "<i2", 4), ("uv", "<u1", 4)])
    rows["position"][:, :3] = POSITIONS * 16000
    rows["uv"][:, :2] = UV * 255
    picture = encoded(np.full((4, 4, 3), 9))
    tree = card({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, {"NORMAL": 2})
    tree |= {"extensionsRequired": ["KHR_mesh_quantization"], "textures": [{"source": 0}]}
    tree["images"] = [{"bufferView": 3}]
    tree["bufferViews"] = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 48, "byteStride": 12},
        {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        {"buffer": 0, "byteOffset": 60, "byteLength": 48},
        {"buffer": 0, "byteOffset": 108, "byteLength": len(picture)},
    ]
    tree["accessors"] = [
        {"bufferView": 0, "componentType": 5122, "normalized": True, "type": "VEC3", "count": 4},
        {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        {"bufferView": 2, "componentType": 5126, "type": "VEC3", "count": 4},
        {
            **{"bufferView": 0, "byteOffset": 8, "componentType": 5121},
            **{"normalized": True, "type": "VEC2", "count": 4},
        },
    ]
    part = one(write_glb(tmp_path / "q.glb", tree, [rows.tobytes(), FACES, NORMALS, picture]))
    np.testing.assert_allclose(part.vertices, np.maximum(POSITIONS * 16000, -32767) / 32767, atol=1e-9)
    np.testing.assert_allclose(part.uv, UV)


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_are_the_same_card(tmp_path, write_glb, mode, order):
    path = write_glb(tmp_path / "m.glb", mesh(mode=mode), [POSITIONS, np.array(order, np.uint16)])
    part = one(path)
    ball = trimesh.Trimesh(part.vertices, part.faces, process=False)
    assert ball.area == pytest.approx(4.0)
    np.testing.assert_allclose(ball.face_normals, np.tile((0, 0, 1), (2, 1)), atol=1e-12)


def test_without_normals_triangles_are_flat(tmp_path, write_glb):
    bent = POSITIONS + np.array([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0]], np.float32)
    part = one(write_glb(tmp_path / "b.glb", mesh(), [bent, FACES]))
    expected = trimesh.Trimesh(bent, FACES.reshape(-1, 3), process=False).face_normals
    np.testing.assert_allclose(part.normals[part.faces], np.repeat(expected[:, None], 3, axis=1), atol=1e-6)


def test_nodes_move_their_meshes_as_trimesh_moves_them(tmp_path, write_glb):
    rng = generator(0, "nodes")
    turns = Rotation.random(3, rng=rng).as_quat().tolist()
    nodes = [
        {"children": [1, 2], "rotation": turns[0], "scale": [1, 2, -0.5]},
        {"mesh": 0, "translation": [1, 2, 3], "rotation": turns[1]},
        {"mesh": 0, "matrix": (np.eye(4) + 0.3 * rng.normal(size=(4, 4)) * [[1, 1, 1, 0]]).ravel().tolist()},
    ]
    path = write_glb(tmp_path / "n.glb", card(nodes=nodes), CARD)
    ours = one(path)
    theirs = trimesh.load_scene(path, process=False).to_geometry()
    sets = [np.round(each, 5) for each in (ours.vertices, theirs.vertices)]
    np.testing.assert_allclose(*(each[np.lexsort(each.T)] for each in sets), atol=2e-5)
    cross = np.cross(*(ours.vertices[ours.faces[:, i]] - ours.vertices[ours.faces[:, 0]] for i in (1, 2)))
    outside = (cross * ours.normals[ours.faces[:, 0]]).sum(axis=1)
    assert (outside > 0).all(), "mirrored triangles keep their outside"


@pytest.mark.parametrize("kind", ["WEBP", "AVIF", "JPEG"])
def test_images_of_every_kind_are_read(tmp_path, write_glb, quarters, kind):
    data = encoded(quarters, kind, quality=100)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    tree = card(material, **textured(data))
    if kind != "JPEG":
        name = f"EXT_texture_{kind.lower()}"
        tree |= {"textures": [{"extensions": {name: {"source": 0}}}], "extensionsRequired": [name]}
    part = one(write_glb(tmp_path / "i.glb", tree, [*CARD, data]))
    corners = part.base_color[[3, 3, -4, -4], [3, -4, 3, -4]]
    np.testing.assert_allclose(
        corners, srgb_to_linear(quarters[[3, 3, -4, -4], [3, -4, 3, -4]] / 255), atol=0.03
    )


@pytest.mark.parametrize("codec", sorted(KTX2))
def test_ktx2_is_decoded_where_its_decoder_is_installed(tmp_path, write_glb, quarters, codec):
    pytest.importorskip("opengl_basisu", reason="no decoder of KTX2: pip install 'tron-relight[ktx2]'")
    data = base64.b64decode(KTX2[codec])
    tree = card({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, **textured(data))
    tree["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    part = one(write_glb(tmp_path / "k.glb", tree, [*CARD, data]))
    np.testing.assert_allclose(part.base_color, srgb_to_linear(quarters / 255), atol=0.01)


def test_ktx2_that_cannot_be_read_is_refused_in_a_line():
    pytest.importorskip("opengl_basisu", reason="no decoder of KTX2: pip install 'tron-relight[ktx2]'")
    whole = base64.b64decode(KTX2["etc1s"])
    blocks = whole[:12] + struct.pack("<I", 146) + whole[16:]  # BC7, which is neither Basis nor plain
    for data in (whole[:16], whole[:90], whole[:-40], blocks):
        with pytest.raises(TronError, match="texture cannot be read"):
            decode_image(memoryview(data))


def plain_ktx2(pixels: np.ndarray, code: int, scheme: int = 0) -> bytes:
    """KTX2 of one level: the header, the index, and the pixels behind an empty description."""
    stored = {0: bytes, 2: lambda raw: pyarrow.compress(raw, codec="zstd", asbytes=True), 3: zlib.compress}
    level = stored[scheme](pixels.tobytes())
    height, width = pixels.shape[:2]
    header = struct.pack("<9I", code, 1, width, height, 0, 0, 1, 1, scheme)
    index = struct.pack("<4I2Q", 104, 0, 104, 0, 0, 0) + struct.pack("<3Q", 104, len(level), pixels.nbytes)
    return b"\xabKTX 20\xbb\r\n\x1a\n" + header + index + level


@pytest.mark.parametrize("scheme", [0, 2, 3])
@pytest.mark.parametrize(
    ("code", "order"),
    [(23, [0, 1, 2]), (29, [0, 1, 2]), (36, [2, 1, 0]), (43, [0, 1, 2, 3]), (50, [2, 1, 0, 3])],
)
def test_ktx2_of_plain_pixels_is_read(code: int, order: list[int], scheme: int):
    image = generator(0, "ktx2").integers(0, 256, (5, 3, len(order)), np.uint8)
    data = plain_ktx2(image[..., order], code, scheme)
    np.testing.assert_array_equal(decode_image(memoryview(data)), image)
    with pytest.raises(TronError, match="texture cannot be read"):
        decode_image(memoryview(data[:-9]))


def test_ktx2_without_a_decoder_is_refused_or_its_substitute_is_read(
    tmp_path, write_glb, quarters, monkeypatch
):
    monkeypatch.setitem(__import__("sys").modules, "opengl_basisu", None)
    data = base64.b64decode(KTX2["etc1s"])
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    tree = card(material, **textured(data, data))
    tree["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    with pytest.raises(TronError, match=r"KTX2.*k\.glb.*tron-relight\[ktx2\]"):
        load_model(write_glb(tmp_path / "k.glb", tree, [*CARD, data, encoded(quarters)]))
    tree["textures"][0]["source"] = 1
    part = one(write_glb(tmp_path / "k.glb", tree, [*CARD, data, encoded(quarters)]))
    np.testing.assert_allclose(part.base_color, srgb_to_linear(quarters / 255), atol=1e-6)


def test_the_texture_transform_of_the_specification(tmp_path, write_glb, quarters):
    """Its own example: the lower left quarter of the image, turned clockwise by 90 degrees."""
    transform = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    info = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    data = encoded(quarters)
    tree = card({"pbrMetallicRoughness": {"baseColorTexture": info}}, **textured(data))
    part = one(write_glb(tmp_path / "t.glb", tree, [*CARD, data]))
    assert part.uv.min(axis=0) == pytest.approx((0, 0.5))
    assert part.uv.max(axis=0) == pytest.approx((0.5, 1))
    # The card's lower left corner shows the quarter's lower right one, and its upper left the lower left.
    np.testing.assert_allclose(part.uv[[0, 3]], [(0.5, 1), (0, 1)], atol=1e-6)


def test_textures_with_transforms_of_their_own_are_looked_up_from_the_normal_maps_coordinates(
    tmp_path, write_glb, quarters
):
    def info(scale):
        return {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [scale, scale]}}}

    data = encoded(quarters)
    material = {"pbrMetallicRoughness": {"baseColorTexture": info(3)}, "normalTexture": info(2)}
    part = one(write_glb(tmp_path / "t.glb", card(material, **textured(data)), [*CARD, data]))
    np.testing.assert_allclose(part.uv, 2 * UV)
    np.testing.assert_allclose(part.sampling["base_color"].matrix, np.diag([1.5, 1.5, 1]))
    np.testing.assert_array_equal(part.sampling["normal_map"].matrix, np.eye(3))


def test_a_second_set_of_coordinates_is_used_by_what_names_it(tmp_path, write_glb, quarters):
    data = encoded(quarters)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}
    tree = card(material, {"TEXCOORD_0": 2, "TEXCOORD_1": 3}, **textured(data))
    tree["accessors"] = None
    blobs = [POSITIONS, FACES, np.zeros((4, 2), np.float32), UV, data]
    tree.pop("accessors")
    tree["meshes"][0]["primitives"][0]["attributes"].pop("NORMAL")
    part = one(write_glb(tmp_path / "u.glb", tree, blobs))
    np.testing.assert_array_equal(part.uv, UV[FACES])
    material["normalTexture"] = {"index": 0, "texCoord": 0}
    with pytest.raises(TronError, match=r"two sets of texture coordinates.*u\.glb"):
        load_model(write_glb(tmp_path / "u.glb", tree, blobs))


def test_vertex_colours_multiply(tmp_path, write_glb, quarters):
    colors = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], np.float32)
    data = encoded(quarters)
    factor = {"baseColorFactor": [0.5, 0.25, 1, 1]}
    part = one(
        write_glb(tmp_path / "c.glb", card({"pbrMetallicRoughness": factor}, {"COLOR_0": 4}), [*CARD, colors])
    )
    np.testing.assert_allclose(part.base_color, colors * (0.5, 0.25, 1))
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    tree = card(material, {"COLOR_0": 4}, **textured(data, first=5))
    part = one(write_glb(tmp_path / "c.glb", tree, [*CARD, colors, data]))
    np.testing.assert_allclose(part.tint, colors)
    even = np.full((4, 4), 128, np.uint8)
    tree["accessors"] = [
        {"bufferView": i, "componentType": kind, "type": shape, "count": count}
        for i, (kind, shape, count) in enumerate(
            [(5126, "VEC3", 4), (5123, "SCALAR", 6), (5126, "VEC3", 4), (5126, "VEC2", 4), (5121, "VEC4", 4)]
        )
    ]
    tree["accessors"][4]["normalized"] = True
    part = one(write_glb(tmp_path / "c.glb", tree, [*CARD, even, data]))
    assert part.tint is None, "one colour for all is a factor"
    np.testing.assert_allclose(part.base_color, srgb_to_linear(quarters / 255) * 128 / 255, atol=1e-6)


def test_primitives_of_one_material_keep_colours_of_their_own(tmp_path, write_glb, quarters):
    """Each primitive is of one colour: not a factor of the material's, for the other has another."""
    red, green = (np.tile(np.array(c, np.float32), (4, 1)) for c in ([1, 0, 0], [0, 0.5, 0]))
    data = encoded(quarters)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    tree = card(material, {"COLOR_0": 4}, **textured(data, first=6))
    first = tree["meshes"][0]["primitives"][0]
    tree["meshes"][0]["primitives"].append(first | {"attributes": first["attributes"] | {"COLOR_0": 5}})
    part = one(write_glb(tmp_path / "c.glb", tree, [*CARD, red, green, data]))
    np.testing.assert_array_equal(part.tint, np.concatenate([red, green]))
    np.testing.assert_allclose(part.base_color, srgb_to_linear(quarters / 255), atol=1e-6)


def test_the_scale_of_a_normal_map_multiplies_x_and_y(tmp_path, write_glb):
    stored = np.array([0.3, -0.2, np.sqrt(1 - 0.13)])
    data = encoded(np.broadcast_to(np.round(stored * 127.5 + 127.5), (4, 4, 3)))
    for scale in (0.5, 2.0):
        tree = card({"normalTexture": {"index": 0, "scale": scale}}, **textured(data))
        part = one(write_glb(tmp_path / "n.glb", tree, [*CARD, data]))
        expected = stored * (scale, scale, 1)
        expected /= np.linalg.norm(expected)
        found = 2 * part.normal_map[0, 0] - 1
        np.testing.assert_allclose(found / np.linalg.norm(found), expected, atol=0.01)


def test_specular_glossiness_in_closed_form():
    plastic = metallic_of(np.array([0.2, 0.4, 0.6]), np.full(3, 0.04), np.array(0.7))
    np.testing.assert_allclose(plastic[0], (0.2, 0.4, 0.6), atol=1e-6)
    assert plastic[1] == pytest.approx(0.3)
    assert plastic[2] == pytest.approx(0.0, abs=1e-6)
    gold = np.array([1.0, 0.77, 0.34])
    metal = metallic_of(np.zeros(3), gold, np.array(0.9))
    np.testing.assert_allclose(metal[0], gold, atol=1e-6)
    assert metal[2] == pytest.approx(1.0, abs=1e-6)


def test_specular_glossiness_of_textures_agrees_with_that_of_factors(tmp_path, write_glb):
    color, shine = (90, 140, 60), 100
    data = encoded(np.broadcast_to((*color, shine), (4, 4, 4)))
    name = "KHR_materials_pbrSpecularGlossiness"
    linear = srgb_to_linear(np.array(color) / 255).tolist()
    diffuse = {"diffuseFactor": [0.1, 0.1, 0.1, 1]}
    material = {"extensions": {name: diffuse | {"specularGlossinessTexture": {"index": 0}}}}
    image = one(write_glb(tmp_path / "s.glb", card(material, **textured(data)), [*CARD, data]))
    material = {"extensions": {name: diffuse | {"specularFactor": linear, "glossinessFactor": shine / 255}}}
    factor = one(write_glb(tmp_path / "s.glb", card(material), CARD))
    np.testing.assert_allclose(image.base_color[0, 0], factor.base_color, atol=1e-5)
    np.testing.assert_allclose(image.roughness[0, 0], factor.roughness, atol=1e-5)
    np.testing.assert_allclose(image.metallic[0, 0], factor.metallic, atol=1e-5)
    assert 0.1 < factor.metallic < 0.99


def test_unlit_is_a_rough_dielectric(tmp_path, write_glb):
    material = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"roughnessFactor": 0.1}}
    part = one(write_glb(tmp_path / "u.glb", card(material), CARD))
    assert (part.roughness, part.metallic) == (1.0, 0.0)


def test_primitives_of_one_material_are_one_part(tmp_path, write_glb):
    tree = card()
    tree["meshes"][0]["primitives"] *= 3
    tree["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 0, "translation": [5, 0, 0]}]
    part = one(write_glb(tmp_path / "p.glb", tree, CARD))
    assert len(part.faces) == 12
    assert part.vertices[:, 0].max() == 6


def test_triangles_without_area_are_dropped_and_do_not_count(tmp_path, write_glb):
    far = np.concatenate([POSITIONS, [[1e6, 0, 0]]]).astype(np.float32)
    faces = np.concatenate([FACES, [4, 4, 4, 0, 4, 4]]).astype(np.uint16)
    (part,) = load_model(write_glb(tmp_path / "f.glb", mesh(), [far, faces]))
    assert len(part.faces) == 2
    assert np.ptp(part.vertices[:, 0]) > 1, "the far vertex belongs to no triangle"


def test_the_table_of_extensions_is_in_the_documentation(pytestconfig):
    tables = (("honoured", HONOURED), ("approximated", APPROXIMATED), ("ignored", IGNORED))
    rows = [f"| `{name}` | {kind} | {how} |" for kind, table in tables for name, how in table.items()]
    wanted = "\n".join(["| extension | is | how |", "|---|---|---|", *rows])
    assert wanted in (pytestconfig.rootpath / "docs/guides/models.md").read_text()

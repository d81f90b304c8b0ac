"""Normal maps against tangents that this file computes itself, and textures, as G-buffers show them."""

# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false
# pyright: reportArgumentType=false

import io
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from datagen.truth.build import Geometry, _of_model
from datagen.truth.pathtrace import gbuffers, render_frames
from tron.cameras import Camera
from tron.models.load import load_model
from tron.models.parts import Part, Sampling, split_mirrored
from tron.shading.environments.environment import EnvironmentMap

QUAD = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint16)
TILT = np.array([0.5, 0.3, np.sqrt(1 - 0.34)])
TURNED = {
    "as it is": ((1, 0), (0, 1)),
    "mirrored": ((-1, 0), (0, 1)),
    "upside down": ((1, 0), (0, -1)),
    "rotated": ((0.6, 0.8), (-0.8, 0.6)),
    "rotated and mirrored": ((-0.6, 0.8), (0.8, 0.6)),
    "stretched": ((3, 0), (0, 0.5)),
    "sheared": ((1, 0.7), (0, 1)),
}


def png(pixels):
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def view(parts, position, width=48):
    geometry = Geometry([_of_model(part, 2, i) for i, part in enumerate(parts)])
    camera = Camera.look_at(position, (0, 0, 0), fov_deg=40, width=width, height=width)
    return gbuffers(geometry, [camera])[0], camera


def tangent_frames(corners, uv, normals):
    """T and B (N, 3) of triangles at points with given normals; B points to the image's top.

    Lengyel 2001: T = dP/du made orthogonal to the normal, B = N x T or, where the texture is mirrored, minus
    that. MikkTSpace does the same but for smoothing T over vertices.
    """
    edge = corners[:, 1:] - corners[:, :1]
    step = uv[:, 1:] - uv[:, :1]  # v runs down
    area = step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0]
    along_u = (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:]) / area[:, None]
    along_v = (edge[:, 1] * step[:, 0, :1] - edge[:, 0] * step[:, 1, :1]) / area[:, None]
    tangent = along_u - normals * (normals * along_u).sum(axis=1, keepdims=True)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normals, tangent)
    bitangent *= np.sign((bitangent * -along_v).sum(axis=1, keepdims=True))
    return tangent, bitangent


@pytest.mark.parametrize("turn", TURNED)
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_a_known_normal_map_bends_the_normal_as_gltf_says(tmp_path, write_glb, variant, turn, scale):
    matrix = np.array(TURNED[turn])
    uv = ((QUAD[:, :2] * (0.5, -0.5)) @ matrix.T + 0.25).astype(np.float32)
    data = png(np.broadcast_to(np.round(TILT * 127.5 + 127.5), (8, 8, 3)))
    tree = {
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}
        ],
        "materials": [{"normalTexture": {"index": 0, "scale": scale}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3}],
    }
    path = write_glb(tmp_path / "card.glb", tree, [QUAD, FACES.reshape(-1), uv, data])
    seen, _ = view(load_model(path, up="z"), (0, -0.01, 4))
    normal = np.broadcast_to((0.0, 0.0, 1.0), (2, 3))
    tangent, bitangent = tangent_frames(QUAD[FACES], uv[FACES], normal)
    bent = TILT * (scale, scale, 1)
    bent /= np.linalg.norm(bent)
    expected = bent[0] * tangent[0] + bent[1] * bitangent[0] + bent[2] * normal[0]
    assert seen.valid.sum() > 200
    np.testing.assert_allclose(seen.normal[seen.valid], np.tile(expected, (seen.valid.sum(), 1)), atol=0.01)


def test_a_models_normals_are_those_of_tangents_computed_here(shared_data, variant):
    """Flight helmet: triangles, interpolation, texture look-up and tangents without Mitsuba."""
    parts = load_model(shared_data / "assets/FlightHelmet/FlightHelmet.gltf")
    owner = np.concatenate([np.full(len(part.faces), i) for i, part in enumerate(parts)])
    local = np.concatenate([np.arange(len(part.faces)) for part in parts])
    corners = np.concatenate([part.vertices[part.faces] for part in parts])
    tree = cKDTree(corners.mean(axis=1))
    for angle in (0.4, 3.0):
        position = 2.4 * np.array([np.sin(angle), -np.cos(angle), 0.4])
        seen, camera = view(parts, tuple(position), width=96)
        rays, points = camera.rays()[seen.valid], seen.position[seen.valid].astype(np.float64)
        _, near = tree.query(points, k=24)
        pairs = np.repeat(points, 24, axis=0)
        closest = trimesh.triangles.closest_point(corners[near.ravel()], pairs)
        distance = np.linalg.norm(closest - pairs, axis=1).reshape(near.shape)
        face = np.take_along_axis(near, distance.argmin(axis=1)[:, None], axis=1)[:, 0]
        # Where a second triangle is as near (an edge, a seam, a doubled surface), which was hit is open.
        clear = (distance.min(axis=1) < 1e-5) & ((distance < 1e-4).sum(axis=1) == 1)
        angles = []
        for index, part in enumerate(parts):
            mine = np.flatnonzero(clear & (owner[face] == index))
            if part.normal_map is None or not len(mine):
                continue
            expected = _expected(part, local[face[mine]], points[mine])
            a, b, c = (corners[face[mine], i] for i in range(3))
            behind = (np.cross(b - a, c - a) * rays[mine]).sum(axis=1) > 0
            expected[behind] *= -1
            cosine = (expected * seen.normal[seen.valid][mine]).sum(axis=1)
            angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        angles = np.concatenate(angles)
        assert len(angles) > 1000
        assert np.quantile(angles, 0.99) < 0.5


def _expected(part, faces, points):
    """(N, 3) unit normals of points on a part's triangles, bent by its normal map."""
    index = part.faces[faces]
    corners = part.vertices[index]
    weights = trimesh.triangles.points_to_barycentric(corners, points)[..., None]
    normals = (part.normals[index] * weights).sum(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = (part.uv[index] * weights).sum(axis=1)
    # split_mirrored turned y over where the texture is mirrored; there B, as used, is N x T.
    tangent, _ = tangent_frames(corners, part.uv[index].astype(np.float64), normals)
    bent = 2 * _bilinear(part.normal_map, uv) - 1
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    bitangent = np.cross(normals, tangent)
    return bent[:, :1] * tangent + bent[:, 1:2] * bitangent + bent[:, 2:] * normals


def _bilinear(image, uv):
    height, width = image.shape[:2]
    at = uv % 1.0 * (width, height) - 0.5
    low = np.floor(at).astype(int)
    fraction = at - low
    total = 0.0
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.where(dx, fraction[:, 0], 1 - fraction[:, 0])
            weight = weight * np.where(dy, fraction[:, 1], 1 - fraction[:, 1])
            total = total + weight[:, None] * image[(low[:, 1] + dy) % height, (low[:, 0] + dx) % width]
    return total


def card(**more):
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    vertices = QUAD - (0, 1, 0)
    part = Part(vertices, np.tile((0.0, 0, 1), (4, 1)), FACES.astype(int), uv, np.ones(3), 1.0, 0.0, None)
    return replace(part, **more)


def test_vertex_colours_tint_the_texture_in_path_tracer_and_g_buffers(variant):
    image = np.zeros((4, 4, 3), np.float32)
    image[:, :2], image[:, 2:] = (0.2, 0.4, 0.6), (0.8, 0.4, 0.2)
    tint = np.array([[1, 1, 1], [1, 1, 1], [0, 0.5, 1], [0, 0.5, 1]], np.float32)
    seen, _ = view([card(base_color=image, tint=tint)], (0, -0.01, 4))
    for x, y in ((-0.5, -0.6), (0.5, 0.3), (-0.5, 0.7)):
        near = seen.valid & (np.hypot(seen.position[..., 0] - x, seen.position[..., 1] - y) < 0.1)
        up = (seen.position[near][:, 1:2] + 1) / 2
        color = image[0, 0] if x < 0 else image[0, 3]
        expected = color * ((1 - up) * tint[0] + up * tint[2])
        assert near.sum() > 2
        np.testing.assert_allclose(seen.base_color[near], expected, atol=2e-3)
    plain = Geometry([_of_model(card(base_color=image, tint=tint), 2, 0)])
    folded = Geometry([_of_model(card(base_color=np.float32(image[:1, :1] * 0.5)), 2, 0)])
    same = Geometry([_of_model(card(base_color=image[:1, :1], tint=np.full((4, 3), 0.5, np.float32)), 2, 0)])
    camera = Camera.look_at((0, -0.01, 4), (0, 0, 0), fov_deg=40, width=16, height=16)
    white = EnvironmentMap.constant(1.0)
    frames = [render_frames(each.lit(white), [camera], 4, [1]) for each in (folded, same, plain)]
    np.testing.assert_allclose(frames[0], frames[1], atol=1e-5)
    assert np.isfinite(frames[2]).all()


@pytest.mark.parametrize(("wrap", "expected"), [("repeat", 0.1), ("clamp", 0.8), ("mirror", 0.8)])
def test_textures_go_on_as_the_sampler_says(variant, wrap, expected):
    image = np.full((64, 64, 3), 0.1, np.float32)
    image[:, 32:] = 0.8
    part = card(base_color=image, sampling={"base_color": Sampling(np.diag([1.3, 1.0, 1.0]), wrap)})
    seen, _ = view([part], (0, -0.01, 4))
    beyond = seen.valid & (seen.position[..., 0] > 0.75)
    assert beyond.sum() > 10
    np.testing.assert_allclose(seen.base_color[beyond], expected, atol=0.01)


def test_only_mirrored_triangles_are_split_off(variant):
    uv = np.array([[0, 1], [1, 1], [1, 0], [2, 1]], np.float32)  # the second triangle is mirrored
    parts = split_mirrored(card(uv=uv, normal_map=np.full((2, 2, 3), 0.7, np.float32)))
    assert [part.faces.tolist() for part in parts] == [[[0, 1, 2]], [[0, 2, 3]]]
    assert mi.variant() == variant
    np.testing.assert_allclose(parts[1].normal_map[..., 1], 0.3, atol=1e-6)

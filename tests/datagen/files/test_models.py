"""The user's models: textures, factors, alpha and normal maps arrive as glTF means them."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from datagen.truth.build import build
from datagen.truth.pathtrace import gbuffers
from datagen.world.objects import ObjectSpec, Placement
from datagen.world.scene import draw_scene
from tron.cameras import Camera
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.models.load import load_model
from tron.models.parts import Part, outline
from tron.seeds import generator

QUAD = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])  # faces +z, y up: a standing card
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def write_quad(path, material, uv=UV, vertices=QUAD):
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = TextureVisuals(uv=uv, material=material)
    path.write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return path


def image(pixels):
    return Image.fromarray(np.asarray(pixels, np.uint8))


@pytest.fixture
def quarters():
    """Red at the top left, then green, blue at the bottom left, then white."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32, :32, 0] = pixels[:32, 32:, 1] = pixels[32:, :32, 2] = 200
    pixels[32:, 32:] = 200
    return pixels


def scene_of(parts, position=(0.0, 0.0, 1.0)):
    drawn = draw_scene(0, "test", 0, style="object", lights=["overcast"], frames=1, path_frames=4)
    item = ObjectSpec(asset="card", size=1.0, placement=Placement(quaternion=(1, 0, 0, 0), position=position))
    return build(drawn.model_copy(update={"objects": (item,)}), {"card": parts})


def front(width=64, height=64):
    """In front of a card that stands in the plane y = 0 and faces -y."""
    return Camera.look_at((0, -4.0, 1.0), (0, 0, 1.0), fov_deg=30, width=width, height=height)


def test_textures_appear_the_right_way_up_and_linear(tmp_path, quarters, variant):
    path = write_quad(
        tmp_path / "card.glb", PBRMaterial(baseColorTexture=image(quarters), metallicFactor=0.0)
    )
    view = gbuffers(scene_of(load_model(path)), [front()])[0]
    card = view.object_id == 2
    value = float(srgb_to_linear(np.array([200 / 255]))[0])
    # The camera looks along +y with x to the right: the image's left is the card's left.
    for point, expected in (
        ((-0.3, 1.3), (value, 0, 0)),
        ((0.3, 1.3), (0, value, 0)),
        ((-0.3, 0.7), (0, 0, value)),
    ):
        near = card & (np.hypot(view.position[..., 0] - point[0], view.position[..., 2] - point[1]) < 0.1)
        assert near.sum() > 4
        np.testing.assert_allclose(
            view.base_color[near], np.broadcast_to(expected, (near.sum(), 3)), atol=0.01
        )


def test_factors_and_packed_textures_multiply(tmp_path, variant):
    packed = np.zeros((8, 8, 3), np.uint8)
    packed[..., 1], packed[..., 2] = 128, 255
    material = PBRMaterial(
        baseColorFactor=[128, 255, 0, 255],
        metallicRoughnessTexture=image(packed),
        roughnessFactor=0.5,
        metallicFactor=0.6,
    )
    view = gbuffers(scene_of(load_model(write_quad(tmp_path / "card.glb", material))), [front()])[0]
    card = view.object_id == 2
    np.testing.assert_allclose(view.roughness[card], 0.5 * 128 / 255, atol=1e-3)
    np.testing.assert_allclose(view.metallic[card], 0.6, atol=1e-3)
    np.testing.assert_allclose(view.base_color[card] - (128 / 255, 1, 0), 0, atol=1e-3)


def test_a_model_stands_in_the_unit_ball_whatever_its_scale(tmp_path):
    for scale in (0.01, 300.0):
        path = write_quad(tmp_path / "card.glb", PBRMaterial(), vertices=QUAD * scale + 7 * scale)
        hull = outline(load_model(path))
        assert np.linalg.norm(hull.vertices, axis=1).max() == pytest.approx(1.0)
        assert np.ptp(hull.vertices[:, 2]) > 1.0, "y up became z up"
        assert np.ptp(hull.vertices[:, 1]) < 1e-6


def test_transparent_triangles_are_left_out_and_opaque_material_ignores_alpha(tmp_path):
    pixels = np.full((64, 64, 4), 255, np.uint8)
    pixels[:, :, 3] = 0  # all clear ...
    rows = np.arange(64)
    pixels[rows[:, None] < rows[None, :], 3] = 255  # ... but the upper right triangle
    for mode, area in (("MASK", 0.5), ("BLEND", 0.5), ("OPAQUE", 1.0)):
        material = PBRMaterial(baseColorTexture=image(pixels), alphaMode=mode, alphaCutoff=0.5)
        mesh = [[0, 0], [1, 0], [1, 1], [0, 1]]
        parts = load_model(write_quad(tmp_path / f"{mode}.glb", material, uv=np.array(mesh)[[3, 0, 1, 2]]))
        found = outline(parts).area / np.ptp(outline(parts).vertices[:, [0, 2]], axis=0).prod()
        assert found == pytest.approx(area, abs=0.02), mode


def test_a_wholly_transparent_model_is_an_error(tmp_path):
    material = PBRMaterial(baseColorFactor=[255, 255, 255, 10], alphaMode="BLEND")
    with pytest.raises(TronError, match="no opaque"):
        load_model(write_quad(tmp_path / "glass.glb", material))


@pytest.mark.parametrize("mirrored", [False, True])
def test_normal_maps_bend_towards_the_images_right_and_top(tmp_path, mirrored, variant):
    tilt = np.array([0.5, 0.3, np.sqrt(1 - 0.34)])
    texture = np.broadcast_to(np.round((tilt * 0.5 + 0.5) * 255), (8, 8, 3))
    uv = UV * (-1, 1) + (1, 0) if mirrored else UV
    parts = load_model(write_quad(tmp_path / "card.glb", PBRMaterial(normalTexture=image(texture)), uv=uv))
    view = gbuffers(scene_of(parts), [front()])[0]
    # The card's image right is world +x (or -x where it is mirrored), its image top is +z, and it faces -y.
    expected = np.array([-tilt[0] if mirrored else tilt[0], -tilt[2], tilt[1]])
    error = view.normal[view.object_id == 2] - expected
    assert np.abs(error).max() < 0.01


def test_the_true_normal_is_the_one_that_mitsuba_shades_with(variant):
    """The white diffuse response is the cosine with the normal in use: three lights recover it."""
    rng = generator(0, "lights")
    ball = trimesh.creation.icosphere(3)
    v = np.asarray(ball.vertices)
    uv = np.column_stack([0.3 * v[:, 0] + 0.1 * v[:, 2], 0.4 * v[:, 2]]).astype(np.float32)
    tilt = np.array([0.25, -0.2, 0.0])
    tilt[2] = np.sqrt(1 - (tilt**2).sum())
    part = Part(v, v, np.asarray(ball.faces), uv, np.ones(3), 1.0, 0.0, np.tile(tilt * 0.5 + 0.5, (4, 4, 1)))
    geometry = scene_of([part])
    surface = geometry.surfaces[1]
    diffuse = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}})
    bent = mi.load_dict({"type": "normalmap", "normalmap": surface.normal_map, "bsdf": diffuse})
    camera = front(24, 24)
    view = gbuffers(geometry, [camera])[0]
    rays = camera.rays().reshape(-1, 3)
    ray = mi.Ray3f(mi.Point3f(*map(float, camera.position)), mi.Vector3f(rays.T))
    si = geometry.lit().ray_intersect(ray)
    ours = view.normal.reshape(-1, 3)
    lights = [ours + 0.35 * rng.normal(size=ours.shape) for _ in range(3)]
    lights = [light / np.linalg.norm(light, axis=1, keepdims=True) for light in lights]
    context = mi.BSDFContext()
    answer = [
        np.array(bent.eval(context, si, si.to_local(mi.Vector3f(light.T.astype(np.float32)))))[0] * np.pi
        for light in lights
    ]
    n = np.linalg.solve(np.stack(lights, axis=1), np.stack(answer, axis=1)[..., None])[..., 0]
    middle = (
        (view.object_id.ravel() == 2)
        & ((ours * rays).sum(axis=1) < -0.6)
        & (np.stack(answer).min(axis=0) > 0.1)
    )
    assert middle.sum() > 20
    cosine = (n * ours).sum(axis=1)[middle] / np.linalg.norm(n[middle], axis=1)
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 2.0


@pytest.mark.parametrize("content", [b"", b"glTF\x02\x00\x00\x00\xff\xff\xff\x7f", b"{}", b"\x00" * 1000])
def test_damaged_models_are_one_line_errors(tmp_path, content):
    for suffix in (".glb", ".gltf", ".obj"):
        path = tmp_path / f"bad{suffix}"
        path.write_bytes(content)
        with pytest.raises(TronError) as caught:
            load_model(path)
        assert "\n" not in str(caught.value)
        assert path.name in str(caught.value)


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(TronError, match=r"not found.*none\.glb"):
        load_model(tmp_path / "none.glb")

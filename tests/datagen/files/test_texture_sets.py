"""The user's texture sets: found by their names, refused in one line, laid on as they are."""

import gc
import json
import re
import struct
import weakref

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from datagen.files.sources import Sources
from datagen.files.texture_sets import find_texture_sets, opened
from datagen.settings.command import Settings
from datagen.truth import build, texels
from datagen.truth.build import scene_geometry
from datagen.world.materials.photographed import Photographed, PhotographedSpec, height_from_normals
from datagen.world.scene import draw_scene
from datagen.world.shapes import ShapeSpec, make_pieces, split_creases
from datagen.world.styles import Choice
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.images import write_image
from tron.seeds import generator


def picture(path, value, size=16):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.full((size, size, 3), value, np.float32))


def licensed(folder, *names):
    entries = [{"path": name, "licence": "CC0-1.0", "author": "me", "source": "here"} for name in names]
    (folder / "catalogue.json").write_text(json.dumps(entries))


@pytest.fixture
def folder(tmp_path):
    for name in ("diff_2k.jpg", "arm_2k.jpg", "nor_gl_2k.exr", "disp_2k.png"):
        picture(tmp_path / f"wood_floor/wood_floor_{name}", 0.5)
    for name in (
        "Color",
        "NormalDX",
        "NormalGL",
        "Roughness",
        "Metalness",
        "Displacement",
        "AmbientOcclusion",
    ):
        picture(tmp_path / f"Metal032_2K-JPG_{name}.jpg", 0.5)
    picture(tmp_path / "Metal032.png", 0.5)  # ambientCG's preview
    picture(tmp_path / "mine/base_color.png", 0.5)
    picture(tmp_path / "mine/normal_dx.png", 0.5)
    picture(tmp_path / "linen_textile/base_color.png", 0.5)
    licensed(tmp_path, "wood_floor", "Metal032", "mine", "linen_textile")
    return tmp_path


def test_sets_of_poly_haven_ambientcg_and_ones_own_are_found(folder):
    found = {each.asset.id: each for each in find_texture_sets(folder)}
    kinds = {name: {kind for kind, _ in each.maps} for name, each in found.items()}
    assert kinds == {
        "wood_floor": {"albedo", "packed", "normal", "height"},
        "Metal032": {"albedo", "normal", "roughness", "metallic", "height", "ao"},
        "mine": {"albedo", "normal"},
        "linen_textile": {"albedo"},
    }
    assert {name: each.role for name, each in found.items()} == {
        "wood_floor": "wood",
        "Metal032": "metal",
        "mine": "any",
        "linen_textile": "fabric",
    }
    assert not found["Metal032"].directx, "OpenGL's normals are taken where both are there"
    assert "NormalGL" in dict(found["Metal032"].maps)["normal"]
    assert found["mine"].directx
    assert found["wood_floor"].asset.licence == "CC0-1.0"


def test_the_hash_names_every_file(folder):
    before = {each.asset.id: each.asset.sha256 for each in find_texture_sets(folder)}
    picture(folder / "mine/normal_dx.png", 0.6)
    after = {each.asset.id: each.asset.sha256 for each in find_texture_sets(folder)}
    assert {name for name in before if before[name] != after[name]} == {"mine"}


def test_what_cannot_be_used_is_one_line(folder, tmp_path_factory):
    (folder / "catalogue.json").unlink()
    named = "4 texture sets have no licence: Metal032, linen_textile, mine, wood_floor.*allow_unlicensed=all"
    with pytest.raises(TronError, match=named):
        find_texture_sets(folder)
    assert len(find_texture_sets(folder, allow_unlicensed="all")) == 4
    names = ["wood_floor", "Metal032", "mine", "linen_textile"]
    assert len(find_texture_sets(folder, allow_unlicensed=names)) == 4
    picture(folder / "bare/bare_rough_1k.png", 0.5)
    with pytest.raises(TronError, match=r"'bare' has no albedo.*bare_albedo\.png"):
        find_texture_sets(folder, allow_unlicensed=names)
    picture(folder / "bare/bare_diff_1k.png", 0.5)
    (folder / "bare/bare_rough_1k.png").write_bytes(b"\x89PNG\r\n\x1a\nnot")
    with pytest.raises(TronError, match="bare_rough_1k") as caught:
        find_texture_sets(folder, allow_unlicensed=[*names, "bare"])
    assert "\n" not in str(caught.value)
    with pytest.raises(TronError, match="not found"):
        find_texture_sets(folder / "none")
    with pytest.raises(TronError, match="no texture sets"):
        find_texture_sets(tmp_path_factory.mktemp("empty"))


def test_colours_become_linear_and_data_stay(folder):
    picture(folder / "mine/base_color.png", 128 / 255)
    picture(folder / "mine/roughness.png", 64 / 255)
    sets = find_texture_sets(folder)
    chosen = next(each for each in sets if each.asset.id == "mine")
    spec = PhotographedSpec.draw(generator(0, "t"), "mine", chosen.asset.sha256)
    image = opened(spec, folder, sets, 50.0).image
    np.testing.assert_allclose(image[..., :3], srgb_to_linear(np.array(128 / 255)), atol=1e-6)
    np.testing.assert_allclose(image[..., 3], 64 / 255, atol=1e-6)
    np.testing.assert_array_equal(image[..., 4], 0.0)
    with pytest.raises(TronError, match="is not what it was"):
        opened(spec.model_copy(update={"sha256": "0"}), folder, sets, 50.0)


def test_albedo_alone_is_converted_from_what_a_file_says(folder):
    """gAMA of 1: the values are light already. Roughness and normals are what they are."""
    tags = PngImagePlugin.PngInfo()
    tags.add(b"gAMA", struct.pack(">I", 100_000))
    for name, value in (("base_color", 128), ("roughness", 128), ("normal_dx", 128)):
        pixels = np.full((16, 16, 3), value, np.uint8)
        Image.fromarray(pixels).save(folder / f"mine/{name}.png", pnginfo=tags)
    sets = find_texture_sets(folder)
    (mine,) = (each for each in sets if each.asset.id == "mine")
    spec = PhotographedSpec.draw(generator(0, "gamma"), "mine", mine.asset.sha256)
    image = opened(spec, folder, sets, 16).image
    np.testing.assert_allclose(image[..., :4], 128 / 255, atol=2e-3)
    assert np.abs(image[..., 5]).max() < 1e-3


def image_of(folder, width):
    """(h, w, 6) of the set ``mine``, about ``width`` wide."""
    sets = find_texture_sets(folder)
    sha256 = next(each.asset.sha256 for each in sets if each.asset.id == "mine")
    spec = PhotographedSpec(texture_set="mine", sha256=sha256, repeat=1.0, offset=(0.0, 0.0, 0.0))
    return opened(spec, folder, sets, width).image


def test_a_packed_map_holds_roughness_in_green_and_metallic_in_blue(folder):
    picture(folder / "mine/arm.png", (229 / 255, 51 / 255, 102 / 255))
    np.testing.assert_allclose(image_of(folder, 16)[0, 0, 3:5], [51 / 255, 102 / 255], atol=1e-6)
    picture(folder / "mine/rough.png", 204 / 255)
    np.testing.assert_allclose(image_of(folder, 16)[0, 0, 3:5], [204 / 255, 102 / 255], atol=1e-6)


def test_a_hill_is_a_hill_by_normals_of_opengl_and_of_directx(folder):
    down, right = np.indices((32, 32)) / 32
    normals = np.dstack([np.sin(2 * np.pi * right), np.sin(4 * np.pi * down), np.full((32, 32), 4.0)])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    (folder / "mine/normal_dx.png").unlink()
    heights = []
    for name, up in (("gl", 1.0), ("dx", -1.0)):
        write_image(
            folder / f"mine/normal_{name}.exr", (0.5 + 0.5 * normals * (1.0, up, 1.0)).astype(np.float32)
        )
        heights.append(image_of(folder, 16)[..., 5])
        (folder / f"mine/normal_{name}.exr").unlink()
    assert np.ptp(heights[0]) > 0.01
    np.testing.assert_allclose(heights[1], heights[0], atol=1e-4)


def test_images_are_averaged_in_the_light_and_stay_as_wide_as_asked(folder):
    pixels = generator(0, "p").random((40, 40, 3)).astype(np.float32)
    write_image(folder / "mine/base_color.png", pixels)
    linear = srgb_to_linear(np.round(pixels * 255) / 255)
    for width, block in ((40, 1), (21, 1), (20, 2), (10, 4), (9, 4), (1, 40)):
        seen = image_of(folder, width)[..., :3]
        expected = linear.reshape(40 // block, block, 40 // block, block, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_a_worker_does_not_gather_the_images_of_all_its_scenes(folder):
    sets = find_texture_sets(folder)
    chosen = next(each for each in sets if each.asset.id == "mine")
    spec = PhotographedSpec.draw(generator(0, "t"), "mine", chosen.asset.sha256)
    # Every scene wants a size of its own.
    seen = [weakref.ref(opened(spec, folder, sets, density).image) for density in range(1, 30)]
    gc.collect()
    assert sum(image() is not None for image in seen) <= 4


def test_a_checkerboard_lies_on_a_box_as_it_should():
    """Squares a quarter of the image, 4 to a unit: read back by the formula on each of the six sides."""
    size = 64
    rows, columns = np.indices((size, size)) // (size // 4)
    image = np.zeros((size, size, 6), np.float32)
    image[..., :3] = ((rows + columns) % 2)[..., None]
    spec = PhotographedSpec(texture_set="c", sha256="", repeat=1.0, offset=(0.0, 0.0, 0.0))
    rng = generator(3, "checker")
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = rng.uniform(-2, 2, (500, 3))
            normals = np.zeros_like(points)
            normals[:, axis] = sign
            seen = Photographed(spec, image).evaluate(points, normals).base_color[:, 0]
            right, up = ((1, 2), (0, 2), (0, 1))[axis]
            mirrored = sign * (-1.0 if axis == 1 else 1.0)
            u, v = mirrored * points[:, right], -points[:, up]
            expected = (np.floor(4 * u) + np.floor(4 * v)) % 2
            edge = np.minimum(np.abs(4 * u - np.round(4 * u)), np.abs(4 * v - np.round(4 * v))) < 0.04
            np.testing.assert_allclose(seen[~edge], expected[~edge], atol=1e-5)


@pytest.mark.parametrize("shape", [(64, 64), (48, 96)])
def test_height_has_the_slopes_of_its_normals(shape):
    y, x = np.meshgrid(*(np.arange(n) / shape[1] for n in shape), indexing="ij")
    high = shape[0] / shape[1]
    height = 0.01 * np.sin(2 * np.pi * 2 * x) * np.cos(2 * np.pi * y / high)
    dx = 0.04 * np.pi * np.cos(2 * np.pi * 2 * x) * np.cos(2 * np.pi * y / high)
    down = -0.02 * np.pi / high * np.sin(2 * np.pi * 2 * x) * np.sin(2 * np.pi * y / high)
    normals = np.dstack([-dx, down, np.ones(shape)])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    np.testing.assert_allclose(height_from_normals(normals), height, atol=1e-6)


def test_scenes_wear_them_where_they_suit_and_are_else_the_same(folder):
    sets = tuple(find_texture_sets(folder))
    keys = {"style": "object", "lights": ["overcast"], "frames": 1, "path_frames": 4}

    def draw(share):
        return draw_scene(0, "train", 1, choice=Choice(textures=sets, texture_share=share), **keys)

    plain = draw_scene(0, "train", 1, **keys)
    assert draw(0.0).to_json() == plain.to_json()
    spec = draw(1.0)
    assert all(m.family == "photographed" for item in spec.objects for m in item.materials)
    assert [o.placement for o in spec.objects] == [o.placement for o in plain.objects]
    assert re.search(r'"sha256": "[0-9a-f]{64}"', spec.to_json())
    with pytest.raises(TronError, match="needs the texture set"):
        build.build(spec, edge=0.3, texels_per_unit=8.0)


@pytest.mark.usefixtures("variant")
def test_a_scene_is_built_with_the_folder_of_the_settings(folder, tmp_path):
    picture(folder / "mine/base_color.exr", (0.2, 0.4, 0.6))
    (folder / "mine/base_color.png").unlink()
    sets = tuple(each for each in find_texture_sets(folder) if each.asset.id == "mine")
    spec = draw_scene(
        0,
        "train",
        1,
        style="object",
        lights=["overcast"],
        frames=1,
        path_frames=4,
        choice=Choice(textures=sets, texture_share=1.0),
    )
    settings = Settings(output_dir=tmp_path, textures=folder, mesh_edge=0.3, texels_per_unit=8.0)
    (surface,) = scene_geometry(spec, settings, Sources(textures=sets)).surfaces
    color = surface.material
    assert color is not None
    mesh, _ = make_pieces(ShapeSpec(kind="box", size=0.5, parameters=(0.5, 0.5, 0.5, 0.5)), 1.0)[0]
    material = opened(spec.objects[0].materials[0], folder, sets, 8.0)
    atlas = texels.bake([texels.Surface(*split_creases(mesh), material)], 8.0)
    lit = atlas.base_color[atlas.base_color.any(axis=2)]
    np.testing.assert_allclose(lit, np.broadcast_to((0.2, 0.4, 0.6), lit.shape), atol=1e-3)

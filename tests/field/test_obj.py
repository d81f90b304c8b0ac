"""OBJ models as exporters write them: each surface right, or a line that says what is not there."""

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from datagen.files.contents import model_contents
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.models.load import load_model

CARD = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
PLAIN = CARD + "mtllib a.mtl\nusemtl m\n" + FACE
RED, BLUE, GREY = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8), (180 / 255,) * 3


@pytest.fixture
def folder(tmp_path):
    """Textures: paint.png, whose lower half is green; mask.png, whose left half is clear; and others."""
    paint = np.full((8, 8, 3), 200, np.uint8)
    paint[4:] = (0, 200, 0)
    mask = np.zeros((8, 8), np.uint8)
    mask[:, 4:] = 255
    normals = np.full((8, 8, 3), (160, 128, 240), np.uint8)
    packed = np.zeros((8, 8, 3), np.uint8)
    packed[...] = (51, 102, 204)
    (tmp_path / "tex tures").mkdir()
    (tmp_path / "textures").mkdir()
    for name, pixels in {
        "paint.png": paint, "textures/paint.png": paint, "tex tures/my paint.png": paint, "mask.png": mask,
        "normals.png": normals, "heights.png": mask, "packed.png": packed,
    }.items():  # fmt: skip
        Image.fromarray(pixels).save(tmp_path / name)
    return tmp_path


def read(folder, obj, **libraries):
    (folder / "model.obj").write_bytes(obj.encode())
    for name, text in libraries.items():
        (folder / f"{name}.mtl").write_bytes(text.encode())
    return load_model(folder / "model.obj", up="z")


def linear(color):
    return pytest.approx(np.asarray(srgb_to_linear(np.array(color))), abs=2e-3)


COLORS = {
    "no material, texture coordinates": (CARD + FACE, {}, GREY),
    "another material's library": (PLAIN, {"a": "newmtl other\nKd 0.8 0.1 0.1\n"}, GREY),
    "two libraries on a line": (
        CARD + "mtllib a.mtl b.mtl\nusemtl m\n" + FACE,
        {"a": "newmtl n\nKd 0.8 0.1 0.1\n", "b": "newmtl m\nKd 0.1 0.1 0.8\n"}, BLUE,
    ),
    "two lines of libraries": (
        "mtllib a.mtl\nmtllib b.mtl\n" + CARD + "usemtl m\n" + FACE,
        {"a": "newmtl n\nKd 0.8 0.1 0.1\n", "b": "newmtl m\nKd 0.1 0.1 0.8\n"}, BLUE,
    ),
    "one of two is missing": (
        CARD + "mtllib none.mtl a.mtl\nusemtl m\n" + FACE, {"a": "newmtl m\nKd 0.1 0.1 0.8\n"}, BLUE,
    ),
    "a library of spaces": (
        CARD + "mtllib my a.mtl\nusemtl m\n" + FACE, {"my a": "newmtl m\nKd .8 .1 .1"}, RED,
    ),
    "a library in a folder, backslash": (
        CARD + "mtllib .\\textures\\..\\a.mtl\nusemtl m\n" + FACE, {"a": "newmtl m\nKd 0.8 0.1 0.1"}, RED,
    ),
    "an empty name": (CARD + "mtllib a.mtl\nusemtl \n" + FACE, {"a": "newmtl \nKd 0.8 0.1 0.1\n"}, RED),
    "a name with spaces": (
        CARD + "mtllib a.mtl\nusemtl red  paint\n" + FACE, {"a": "newmtl red  paint\nKd 0.8 0.1 0.1\n"}, RED,
    ),
    "continued lines": (
        CARD + "mtllib \\\na.mtl\nusemtl m\nf 1/1 2/2 \\\n3/3 4/4\n", {"a": "newmtl m\nKd 0.8 \\\n 0.1 0.1"},
        RED,
    ),
    "carriage returns": (PLAIN.replace("\n", "\r\n"), {"a": "newmtl m\r\nKd 0.8 0.1 0.1\r\n"}, RED),
    "tabs, capitals and a byte order mark": (PLAIN, {"a": "\ufeffnewmtl\tm\n\tKD\t0.8 0.1 0.1\n"}, RED),
    "one number of colour": (PLAIN, {"a": "newmtl m\nKd 0.8\n"}, (0.8, 0.8, 0.8)),
    "a texture without a name": (PLAIN, {"a": "newmtl m\nKd 0.8 0.1 0.1\nmap_Kd \nbump\n"}, RED),
    "a second of that name": (PLAIN, {"a": "newmtl m\nKd 0.8 0.1 0.1\nnewmtl m\nKd 0 1 0\n"}, RED),
}  # fmt: skip


@pytest.mark.parametrize("kind", COLORS)
def test_materials_are_found_by_name(folder, kind):
    obj, libraries, color = COLORS[kind]
    (part,) = read(folder, obj, **libraries)
    assert part.base_color == linear(color)
    assert len(part.faces) == 2


TEXTURES = {
    "plain": ("map_Kd paint.png", np.eye(3), "repeat"),
    "backslashes": ("map_Kd textures\\paint.png", np.eye(3), "repeat"),
    "doubled backslashes": ("map_Kd .\\\\textures\\\\paint.png", np.eye(3), "repeat"),
    "spaces": ("map_Kd tex tures/my paint.png", np.eye(3), "repeat"),
    "quotes": ('map_Kd "paint.png"', np.eye(3), "repeat"),
    "scale": ("map_Kd -s 2 3 1 textures/paint.png", [[2, 0, 0], [0, 3, -2], [0, 0, 1]], "repeat"),
    "offset": ("map_Kd -o 0.25 0.5 paint.png", [[1, 0, 0.25], [0, 1, -0.5], [0, 0, 1]], "repeat"),
    "one number each": ("map_Kd -s 2 -o 0.1 paint.png", [[2, 0, 0.1], [0, 1, 0], [0, 0, 1]], "repeat"),
    "clamp": ("map_Kd -clamp on paint.png", np.eye(3), "clamp"),
    "all that ask for nothing": (
        "map_Kd -blendu on -blendv on -mm 0 1 -t 0 0 0 -boost 0 -texres 512 -clamp off "
        "tex tures/my paint.png",
        np.eye(3), "repeat",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", TEXTURES)
def test_textures_are_looked_up_as_their_options_say(folder, kind):
    statement, matrix, wrap = TEXTURES[kind]
    (part,) = read(folder, PLAIN, a=f"newmtl m\nKd 1 1 1\n{statement}\n")
    assert part.base_color.shape == (8, 8, 3)
    assert part.base_color[0, 0] == linear((200 / 255,) * 3)
    np.testing.assert_allclose(part.sampling["base_color"].matrix, matrix, atol=1e-12)
    assert part.sampling["base_color"].wrap == wrap
    content = model_contents(folder, "model.obj", [part])
    assert any(each.path.endswith("paint.png") and each.kind == "texture" for each in content)


def test_a_scale_repeats_the_image_from_the_lower_left(folder):
    (part,) = read(folder, PLAIN, a="newmtl m\nmap_Kd -s 1 2 -o 0 0.5 paint.png\n")
    u, v = 0.3, 0.1  # up: looked up at 2 * 0.1 + 0.5 = 0.7
    found = part.sampling["base_color"].matrix @ (u, 1 - v, 1)
    np.testing.assert_allclose(found[:2], (0.3, 1 - 0.7), atol=1e-12)


def test_gain_changes_the_stored_values(folder):
    (part,) = read(folder, PLAIN, a="newmtl m\nmap_Kd -mm 0.1 0.5 paint.png\n")
    assert part.base_color[0, 0] == linear((0.1 + 0.5 * 200 / 255,) * 3)


OPACITY = {
    "map_d": ("map_Kd paint.png\nmap_d mask.png", 0.5),
    "map_d without a colour": ("Kd 1 1 1\nmap_d mask.png", 0.5),
    "map_d, repeated twice": ("map_Kd paint.png\nmap_d -s 2 1 mask.png", 0.5),
    "map_d, of a channel": ("map_d -imfchan b packed.png", 1.0),
    "map_d, inverted": ("map_d -mm 1 -1 mask.png", 0.5),
    "d of nearly all": ("d 0.9", 1.0),
    "Tr of a little": ("Tr 0.1", 1.0),
    "d before Tr, as exporters write wrongly": ("d 1.0\nTr 1.0", 1.0),
    "Tr before d": ("Tr 1.0\nd 1.0", 1.0),
}


@pytest.mark.parametrize("kind", OPACITY)
def test_what_is_clear_is_cut_away(folder, kind):
    statements, share = OPACITY[kind]
    (part,) = read(folder, PLAIN, a=f"newmtl m\n{statements}\n")
    corners = part.vertices[part.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ).sum()
    extent = np.ptp(part.vertices[part.faces.ravel()], axis=0)
    assert extent[0] / extent[1] == pytest.approx(1.0 if "twice" in kind else share, abs=0.3)
    whole = extent[1] ** 2 * 2  # each triangle's doubled
    assert area / whole == pytest.approx(share, abs=0.1)


def test_a_clear_material_goes_with_a_line(folder, caplog):
    obj = CARD + "mtllib a.mtl\nusemtl m\nf 1/1 2/2 3/3\nusemtl n\nf 1/1 3/3 4/4\n"
    (part,) = read(folder, obj, a="newmtl m\nKd 0.8 0.1 0.1\nnewmtl n\nTr 0.8\n")
    assert part.base_color == linear(RED)
    assert "opacity 0.2" in caplog.text


SURFACES = {
    "numbers": ("Pr 0.25\nPm 0.75", 0.25, 0.75),
    "nothing": ("", 0.6, 0.0),
    "one file, a channel each": (
        "map_Pr -imfchan g packed.png\nmap_Pm -imfchan b packed.png", 102 / 255, 204 / 255
    ),
    "grey": ("Pr 1\nmap_Pr heights.png", None, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", SURFACES)
def test_roughness_and_metallic(folder, kind):
    statements, roughness, metallic = SURFACES[kind]
    (part,) = read(folder, PLAIN, a=f"newmtl m\nKd 1 1 1\n{statements}\n")
    assert np.mean(part.metallic) == pytest.approx(metallic, abs=1e-3)
    if roughness is None:
        assert set(np.unique(np.round(part.roughness, 3))) == {0.0, 1.0}
    else:
        assert np.mean(part.roughness) == pytest.approx(roughness, abs=1e-3)


@pytest.mark.parametrize("key", ["norm", "map_Bump", "bump", "map_norm"])
def test_normal_maps(folder, key):
    (part,) = read(folder, PLAIN, a=f"newmtl m\n{key} -bm 0.5 normals.png\n")
    expected = (0.5 + 0.5 * (160 / 255 - 0.5), 0.5 + 0.5 * (128 / 255 - 0.5), 240 / 255)
    assert part.normal_map is not None
    assert part.normal_map[0, 0] == pytest.approx(np.array(expected), abs=2e-3)
    assert part.roughness == 0.6


LINES = {
    "bump map of heights": "map_Bump -bm 2 heights.png",
    "Ps is not": "Ps 0.5",
    "Pc is not": "Pc 1",
    "-boost is not": "map_Kd -boost 2 paint.png",
    "-t is not": "map_Kd -t 0.3 0.2 paint.png",
}


@pytest.mark.parametrize("said", LINES)
def test_what_is_not_honoured_gets_a_line(folder, caplog, said):
    read(folder, PLAIN, a=f"newmtl m\n{LINES[said]}\n")
    (line,) = [each.getMessage() for each in caplog.records if each.name == "tron.models.obj"]
    assert said in line
    assert "model.obj" in line


def test_materials_of_no_library_are_counted_and_named(folder, caplog):
    read(folder, PLAIN, a="newmtl other\nKd 1 0 0\n")
    assert "1 of 1 materials are in no library and grey: 'm'" in caplog.text


def test_a_texture_needs_coordinates(folder, caplog):
    (part,) = read(
        folder, PLAIN.replace(FACE, "f 1 2 3 4\n"), a="newmtl m\nKd 0.8 0.1 0.1\nmap_Kd paint.png\n"
    )
    assert part.base_color == linear(RED)
    assert "needs texture coordinates" in caplog.text


BAD = {
    "no library": (CARD + "mtllib none.mtl\n" + FACE, "", "none.mtl"),
    "a missing texture": (PLAIN, "map_Kd none.png", "none.png"),
    "a texture outside": (PLAIN, "map_Kd ..\\..\\secret.png", "lies outside"),
    "a drive's": (PLAIN, "map_Kd C:\\art\\paint.png", "lies outside"),
    "words for numbers": (PLAIN, "Kd red", "needs numbers"),
    "a number that is none": (PLAIN, "Pr nan", "needs numbers"),
    "nothing but glass": (PLAIN, "d 0.1", "no opaque triangles"),
}


@pytest.mark.parametrize("kind", BAD)
def test_the_rest_is_refused_in_a_line(folder, kind):
    obj, statements, said = BAD[kind]
    with pytest.raises(TronError, match=said) as refused:
        read(folder, obj, a=f"newmtl m\n{statements}\n")
    assert "\n" not in str(refused.value)


REPORTED = {
    "backslash": None, "emptyname": RED, "mapd": None, "options": None, "two": BLUE, "twolines": BLUE,
    "uv_nomtl": GREY, "uv_other": GREY,
}  # fmt: skip


@pytest.mark.parametrize("name", REPORTED)
def test_models_of_the_field(shared_data, name):
    (part, *_) = load_model(shared_data / f"field/obj/{name}.obj")
    if REPORTED[name] is None:
        assert part.base_color.ndim == 3
    else:
        assert part.base_color == linear(REPORTED[name])


def test_a_texture_says_by_its_gamma_what_its_values_are(folder):
    """gAMA of 1: values are linear light."""
    paint = Image.open(folder / "paint.png")
    tags = PngImagePlugin.PngInfo()
    tags.add(b"gAMA", (100_000).to_bytes(4, "big"))
    paint.save(folder / "paint.png", pnginfo=tags)
    (part,) = read(folder, PLAIN, a="newmtl m\nmap_Kd paint.png\n")
    np.testing.assert_allclose(part.base_color[0, 0], 200 / 255, atol=5e-3)

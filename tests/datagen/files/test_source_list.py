"""What is tested on is not trained on: by content, whatever it is called."""

import numpy as np
import trimesh

from datagen.files.assets import Asset, find_models
from datagen.files.contents import compared, model_contents
from datagen.files.sources import HELD_OUT, families, for_split
from tron.io.images import write_image
from tron.models.load import load_model
from tron.seeds import generator


def hashes(item: tuple[str, str]) -> frozenset[str]:
    return frozenset(item[1].split("+"))


def sides(items: list[tuple[str, str]]) -> tuple[set[str], set[str]]:
    train, test = (for_split(items, split, hashes) for split in ("train", "test"))
    assert train == for_split(items, "validation", hashes) == for_split(items, "train_b", hashes)
    return {name for name, _ in train}, {name for name, _ in test}


def test_every_fourth_is_the_test_splits_and_nothing_is_on_both_sides():
    train, test = sides([(str(i), str(i)) for i in range(9)])
    assert test == {"3", "7"}
    assert train == {str(i) for i in range(9)} - test


def test_fewer_than_four_are_shared():
    train, test = sides([(str(i), str(i)) for i in range(HELD_OUT - 1)])
    assert train == test == {"0", "1", "2"}


def test_copies_go_to_one_side_and_count_once():
    """Eight names of three contents are three things: too few to hold one out."""
    train, test = sides([(str(i), str(i % 3)) for i in range(8)])
    assert train == test
    train, test = sides([("a", "1"), ("b", "2"), ("c", "3"), ("d", "4"), ("again", "4"), ("e", "5")])
    assert test == {"d", "again"}
    assert not train & test


def test_what_shares_a_part_with_a_third_goes_with_it():
    items = [("a", "1"), ("b", "2"), ("c", "3"), ("d", "4+5"), ("e", "6"), ("f", "5+7"), ("g", "7")]
    assert sides(items)[1] == {"d", "f", "g"}
    assert families([hashes(each) for each in items]).tolist() == [0, 1, 2, 3, 4, 3, 3]


def test_a_models_copy_in_another_file_is_found_by_its_triangles(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.export(tmp_path / "ball.glb")
    mesh.export(tmp_path / "sphere.obj", digits=12)
    trimesh.creation.box().export(tmp_path / "box.glb")

    def meshes(name: str) -> set[str]:
        found = model_contents(tmp_path, name, load_model(tmp_path / name))
        return {each.sha256 for each in found if each.kind == "mesh"}

    renamed = (tmp_path / "other.glb").write_bytes((tmp_path / "ball.glb").read_bytes())
    assert renamed
    assert meshes("ball.glb") == meshes("other.glb")
    assert not meshes("ball.glb") & meshes("box.glb")


def textured(folder, name: str, extents: tuple[float, float, float], picture: np.ndarray) -> None:
    """An OBJ box with a texture of its own name beside it."""
    write_image(folder / f"{name}.png", picture)
    (folder / f"{name}.mtl").write_text(f"newmtl skin\nmap_Kd {name}.png\n")
    box = trimesh.creation.box(extents)
    lines = [f"mtllib {name}.mtl", *(f"v {x} {y} {z}" for x, y, z in box.vertices)]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "usemtl skin"]
    lines += [f"f {a + 1}/1 {b + 1}/2 {c + 1}/3" for a, b, c in box.faces]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")


def test_models_that_share_a_texture_go_to_one_side(tmp_path):
    rng = generator(0, "pictures")
    common = rng.uniform(size=(8, 8, 3)).astype(np.float32)
    for i, name in enumerate("abcdef"):
        own = rng.uniform(size=(8, 8, 3)).astype(np.float32)
        textured(tmp_path, name, (1, 1, 1 + 0.1 * i), common if name in "df" else own)
    models, _ = find_models(tmp_path, allow_unlicensed=list("abcdef"))
    kinds = {(each.kind, each.path) for each in models[0].contents}
    assert {("model", "a.obj"), ("library", "a.mtl"), ("texture", "a.png"), ("mesh", "a.obj#mesh")} <= kinds
    assert compared(models[3].contents) & compared(models[5].contents)
    assert {each.id for each in for_split(models, "test", Asset.hashes)} == {"d", "f"}


def test_a_texture_of_one_colour_ties_nothing_together(tmp_path):
    for i, name in enumerate("ab"):
        textured(tmp_path, name, (1, 1, 1 + i), np.full((4, 4, 3), 0.5, np.float32))
    a, b = (model_contents(tmp_path, f"{name}.obj", load_model(tmp_path / f"{name}.obj")) for name in "ab")
    assert {each.sha256 for each in a} & {each.sha256 for each in b}, "they do share a file"
    assert not compared(a) & compared(b)

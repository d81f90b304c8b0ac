"""Models that lie, are damaged or enormous: one line, a second, 200 MB; nothing executed or fetched."""

import io
import json
import re
import struct
import subprocess
import sys
import zlib

import DracoPy
import numpy as np
import pytest
import trimesh
from hydra.utils import get_object
from PIL import Image

from tron.models.load import load_model

POSITIONS = np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
CARD = [POSITIONS, FACES, UV]
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def tree(**more):
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    base = {"meshes": [{"primitives": [primitive]}], "materials": [material]}
    return base | {"textures": [{"source": 0}], "images": [{"bufferView": 3}]} | more


def picture():
    buffer = io.BytesIO()
    Image.fromarray(np.full((4, 4, 3), 200, np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def enormous_png(width, height):
    """A PNG whose header is true and whose rows are missing."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(999)))


def draco(blob, count=4, faces=6):
    """A tree of one compressed primitive."""
    packed = {"bufferView": 0, "attributes": {"POSITION": 0}}
    accessors = [
        {"count": count, "type": "VEC3", "componentType": 5126},
        {"count": faces, "type": "SCALAR", "componentType": 5125},
    ]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    primitive["extensions"] = {"KHR_draco_mesh_compression": packed}
    return {"meshes": [{"primitives": [primitive]}], "accessors": accessors}, [blob]


def accessor(count, kind="VEC3", **more):
    return {"bufferView": 0, "componentType": 5126, "type": kind, "count": count} | more


def draco_blob():
    ball = trimesh.creation.icosphere(2)
    return DracoPy.encode(np.asarray(ball.vertices), np.asarray(ball.faces, np.uint32))


def lying_draco():
    """Its header announces 2 ** 34 triangles."""
    blob = draco_blob()
    at = 12
    while blob[at] & 0x80:
        at += 1
    return blob[: at + 1] + b"\xff\xff\xff\xff\x3f" + blob[at + 3 :]


def uri(text):
    return tree(images=[{"uri": text}]), CARD


def required(name):
    return tree(extensionsRequired=[name]), [*CARD, picture()]


def nodes(*entries):
    return tree(nodes=list(entries)), [*CARD, picture()]


def with_positions(positions):
    return tree(), [np.asarray(positions, np.float32), FACES, UV, picture()]


GLB = {
    "ten million triangles": (
        lambda: (tree(accessors=[accessor(4), accessor(30_000_000, "SCALAR"), accessor(4, "VEC2")]), CARD),
        "more than 15,000,000 elements",
    ),
    "nodes without end": (
        lambda: nodes({"children": list(range(1, 200_001))}, *[{"mesh": 0}] * 200_000),
        "more than 20,000 nodes",
    ),
    "four billion vertices": (
        lambda: (tree(accessors=[accessor(2**32), accessor(6, "SCALAR"), accessor(4, "VEC2")]), CARD),
        "more than 15,000,000 elements",
    ),
    "an accessor past its view": (
        lambda: (tree(accessors=[accessor(5), accessor(6, "SCALAR"), accessor(4, "VEC2")]), CARD),
        "does not lie in its buffer view",
    ),
    "a negative offset": (
        lambda: (
            tree(accessors=[accessor(4, byteOffset=-64), accessor(6, "SCALAR"), accessor(4, "VEC2")]),
            CARD,
        ),
        "does not lie in its buffer view",
    ),
    "a view past its buffer": (
        lambda: (tree(bufferViews=[{"buffer": 0, "byteLength": 2**40}] * 4), CARD),
        "buffer view ends at byte",
    ),
    "an index of no vertex": (
        lambda: (tree(), [POSITIONS, FACES + 9, UV, picture()]),
        "a vertex that it does not hold",
    ),
    "vertices that are not numbers": (
        lambda: with_positions(np.where(np.eye(4, 3), np.nan, POSITIONS)),
        "not finite",
    ),
    "vertices at infinity": (lambda: with_positions(np.where(np.eye(4, 3), np.inf, POSITIONS)), "not finite"),
    "a needle": (lambda: with_positions(POSITIONS * (1e6, 1, 1)), "times longer than wide"),
    "no area": (lambda: with_positions(POSITIONS * (1, 0, 1)), "no opaque triangles"),
    "a point": (lambda: with_positions(POSITIONS * 0), "no opaque triangles"),
    "an enormous texture": (
        lambda: (tree(), [*CARD, enormous_png(30_000, 30_000)]),
        "too large",
    ),
    "a texture of many pixels": (lambda: (tree(), [*CARD, enormous_png(9000, 9000)]), "9000 x 9000"),
    "a texture cut short": (lambda: (tree(), [*CARD, picture()[:40]]), "texture cannot be read"),
    "a texture that is a program": (
        lambda: (tree(), [*CARD, b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nquit\n"]),
        "texture cannot be read",
    ),
    "ktx2 of no size": (
        lambda: (tree(), [*CARD, b"\xabKTX 20\xbb\r\n\x1a\n" + struct.pack("<17I", 0, 1, *[2**31] * 15)]),
        "pixels is too large",
    ),
    "a file above": (lambda: uri("../../../../etc/passwd"), "outside its folder"),
    "a file above, escaped": (lambda: uri("%2e%2e/%2e%2e/etc/passwd"), "outside its folder"),
    "a link out of the folder": (lambda: uri("link.png"), "outside its folder"),
    "an absolute file": (lambda: uri("/etc/passwd"), "not to a file in its folder"),
    "a file by URL": (lambda: uri("file:///etc/passwd"), "not to a file in its folder"),
    "a file of the net": (lambda: uri("http://127.0.0.1:9/x.png"), "not to a file in its folder"),
    "a folder": (lambda: uri("."), "missing"),
    "a missing file": (lambda: uri("none.png"), "'none.png', which is missing"),
    "base64 that is none": (lambda: uri("data:image/png;base64,!!!"), "damaged data URI"),
    "meshopt": (
        lambda: required("EXT_meshopt_compression"),
        "requires the glTF extension EXT_meshopt_compression",
    ),
    "an unknown extension": (lambda: required("ACME_hologram"), "requires the glTF extension ACME_hologram"),
    "a texture of an unknown kind": (
        lambda: (tree(textures=[{"extensions": {"MSFT_texture_dds": {"source": 0}}}]), [*CARD, picture()]),
        "MSFT_texture_dds",
    ),
    "a circle of nodes": (
        lambda: nodes({"children": [1]}, {"children": [0], "mesh": 0}),
        "do not form a tree",
    ),
    "a node of nothing": (lambda: nodes({"children": [7]}), r"nodes\[7\]"),
    "a node that is not finite": (
        lambda: nodes({"mesh": 0, "translation": [1e308, 1e308, float("nan")]}),
        "transform is not finite",
    ),
    "no mesh": (lambda: (tree(nodes=[{}]), [*CARD, picture()]), "no opaque triangles"),
    "draco of nothing": (lambda: draco(b"no"), "Draco"),
    "draco cut short": (lambda: draco(draco_blob()[:200], 162, 960), "Draco mesh cannot be decoded"),
    "draco that lies": (lambda: draco(lying_draco(), 162, 960), "announces [0-9,]{14} triangles"),
    "draco of more than announced": (lambda: draco(draco_blob()), "announces 320 triangles"),
    "lists that are words": (lambda: (tree(meshes="many"), CARD), "cannot be read|does not hold"),
}


def spoil(kind, path):
    """Files that are no model at all, or whose container lies."""
    good = path.read_bytes()
    if kind == "length":
        return good[:8] + struct.pack("<I", 2**31) + good[12:]
    if kind == "chunk":
        return good[:12] + struct.pack("<I", 2**31) + good[16:]
    if kind == "version":
        return good[:4] + struct.pack("<I", 1) + good[8:]
    if kind == "cut":
        return good[: len(good) // 2]
    if kind == "deep":
        text = b'{"asset": ' + b"[" * 900_000 + b"]" * 900_000 + b"}"
        return struct.pack("<5I", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text
    text = b'{"asset": {"version": "2.0"}, "nodes": [' + b"{}," * 20_000_000 + b"{}]}"  # "wide"
    return struct.pack("<5I", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text


MEASURE = """
import json, pathlib, sys, time
from tron.errors import TronError
from tron.models.load import load_model

def peak():
    text = pathlib.Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0])

for path in sys.argv[1:]:
    pathlib.Path("/proc/self/clear_refs").write_text("5")  # the peak is counted anew
    before, start = peak(), time.process_time()
    try:
        load_model(path)
        said = "accepted"
    except TronError as error:
        said = str(error)
    print(json.dumps([said, time.process_time() - start, (peak() - before) / 1024]))
"""


OBJ = {
    ("../../etc/passwd", "a.png"): "outside",
    ("none.mtl", "a.png"): "missing",
    ("card.mtl", "none.png"): "'none.png' cannot be read",
    ("card.mtl", "../../../../etc/passwd"): "cannot be read, or lies outside",
    ("card.mtl", "big.png"): "cannot be read|too large",
    ("card.mtl", "program.png"): "cannot be read|EPS",
}
"""Material library and texture of an OBJ, and what has to be said."""

CONTAINERS = {
    "length": "GLB header says 2,147,483,648 bytes",
    "chunk": "JSON chunk ends at byte",
    "version": "GLB 1",
    "cut": "GLB header says",
    "deep": "RecursionError",
    "wide": "more than 1,000,000 values",
}


def write_bad_files(folder, write_glb):
    """What has to be said of a file, and the file, by name."""
    files = {}
    for number, (name, (make, wanted)) in enumerate(GLB.items()):
        home = folder / f"glb{number}"
        home.mkdir()
        (home / "link.png").symlink_to("/etc/passwd")
        files[name] = wanted, write_glb(home / "bad.glb", *make())
    good = write_glb(folder / "good.glb", tree(), [*CARD, picture()])
    assert load_model(good)
    for kind, wanted in CONTAINERS.items():
        files[kind] = wanted, folder / f"{kind}.glb"
        files[kind][1].write_bytes(spoil(kind, good))
    text = tree(
        asset={"version": "2.0"},
        nodes=[{"mesh": 0}],
        buffers=[{"uri": "short.bin", "byteLength": 2**40}],
        bufferViews=[{"buffer": 0, "byteLength": 2**39}] * 4,
        accessors=[accessor(4), accessor(6, "SCALAR"), accessor(4, "VEC2")],
    )
    (folder / "short.bin").write_bytes(bytes(100))
    files["a buffer beside it"] = "buffer view ends at byte", folder / "bad.gltf"
    files["a buffer beside it"][1].write_text(json.dumps(text))
    for number, ((library, texture), wanted) in enumerate(OBJ.items()):
        home = folder / f"obj{number}"
        home.mkdir()
        (home / "big.png").write_bytes(enormous_png(30_000, 30_000))
        (home / "program.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nquit\n")
        (home / "card.mtl").write_text(f"newmtl m\nmap_Kd {texture}\n")
        files[library, texture] = wanted, home / "card.obj"
        files[library, texture][1].write_text(f"mtllib {library}\n{TRIANGLE}usemtl m\nf 1/1 2/2 3/3\n")
    files["ten million lines"] = "more than 5,000,000 triangles", folder / "big.obj"
    files["ten million lines"][1].write_bytes(TRIANGLE.encode() + b"f 1 2 3\n" * 10_000_000)
    return files


@pytest.mark.long
def test_a_bad_model_costs_one_line_a_second_and_little_memory(tmp_path, write_glb):
    files = write_bad_files(tmp_path, write_glb)
    paths = [path for _, path in files.values()]
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, paths)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    measured = [json.loads(line) for line in done.stdout.splitlines()]
    for (name, (wanted, path)), (said, seconds, megabytes) in zip(files.items(), measured, strict=True):
        assert re.search(wanted, said), (name, said)
        assert "\n" not in said, name
        assert path.name in said, (name, said)
        assert seconds < 1, (name, seconds)
        assert megabytes < 200, (name, megabytes)


@pytest.fixture
def folder(tmp_path, write_glb):
    """Two good models and a bad one, all licensed."""
    folder = tmp_path / "models"
    folder.mkdir()
    for name in ("one", "two"):
        write_glb(folder / f"{name}.glb", tree(), [*CARD, picture()])
    write_glb(folder / "broken.glb", *required("ACME_hologram"))
    entries = [{"path": f"{name}.glb", "licence": "CC0-1.0"} for name in ("one", "two", "broken")]
    (folder / "catalogue.json").write_text(json.dumps(entries))
    return folder


def datagen(*arguments):
    with pytest.raises(SystemExit) as stop:
        get_object("tron.cli.installation.datagen")(list(arguments))
    return stop.value.code


def test_a_model_asked_for_by_name_is_an_error(folder, tmp_path, capsys, variant):
    out = tmp_path / "out"
    assert datagen("experiment=demo", f"assets={folder}", "asset_names=[broken]", f"output_dir={out}") == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "requires the glTF extension ACME_hologram" in err
    assert "broken.glb" in err
    assert not out.exists()


def test_a_folder_of_nothing_usable_is_an_error(folder, tmp_path, capsys, variant):
    for name in ("one", "two"):
        (folder / f"{name}.glb").unlink()
    assert datagen("experiment=demo", f"assets={folder}", f"output_dir={tmp_path / 'out'}") == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "none of the 1 models can be used; 'broken': model requires" in err


def test_a_bad_model_is_left_out_and_counted(folder, tmp_path, caplog, tiny_scenes, variant):
    out = tmp_path / "out"
    arguments = [*tiny_scenes, "train.scenes=1", "cluster=none", f"assets={folder}", f"output_dir={out}"]
    with caplog.at_level("WARNING", "datagen"):
        assert datagen(*arguments) == 0
    left_out = [record.message for record in caplog.records if "left out" in record.message]
    assert ["broken.glb" in message for message in left_out] == [True]
    card = (out / "README.md").read_text()
    assert "Models left out because they cannot be used: 1." in card
    assert "| broken.glb | model requires the glTF extension ACME_hologram" in card
    assert "| one | CC0-1.0" in card
    assert not (out / "failures.jsonl").exists()

"""Hostile files cost a line, a second and 200 MB; nothing in them is executed.

Each kind has also a good file, which its reader must take: a reader that refuses everything refuses
nothing. A file that would run something makes CANARY in the folder that it is read in. Files are read in one
child process, the good one of a kind first: it pays for imports. A child that dies has refused nothing that
was left.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import pickle
import shutil
import struct
import subprocess
import sys
import tarfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.ply import REQUIRED
from tron.gaussians.scene import GaussianScene
from tron.io.images import encode_exr, encode_png
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.schema import SCHEMA_VERSION, ClipMeta, clip_members
from tron.shards.writer import ShardWriter

CANARY = "executed"
GOOD = "a good one"
SHARD = "train-00000.tar"
SIDE = 12

Build = Callable[[Path], Path]
"""Writes a file, or a folder of them, below an empty folder; returns what a reader is given."""


class Explosive:
    """Object whose pickle makes CANARY when it is loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {CANARY}",)


def hostile_files() -> dict[str, dict[str, Build]]:
    """Kind of file -> what is wrong with it -> its builder."""
    return {
        "shard": _shards(),
        "manifest": _manifests(),
        "picture": _pictures(),
        "surfels": _surfels(),
        "capture": _captures(),
        "weights": _weights(),
        "recipe": _recipes(),
    }


def _frames() -> list[dict[str, np.ndarray]]:
    rng = generator(0, "hostile")
    return [{name: rng.random((SIDE, SIDE, 3), np.float32) for name in clip_members(reference=False)}]


def _meta(key: str = "a0") -> ClipMeta:
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), fov_deg=45, width=SIDE, height=SIDE)
    return ClipMeta(
        key=key,
        scene="a",
        light="a",
        light_family="sun",
        split="train",
        frames=1,
        width=SIDE,
        height=SIDE,
        cameras=[camera.to_dict()],
        exposure=1.0,
        color_space={},
    )


def _dataset(folder: Path) -> Path:
    """A dataset of one clip of one frame."""
    frames = _frames()
    for name in ("mask", "foreground"):
        frames[0][name] = np.ones((SIDE, SIDE, 1), np.float32)
    with ShardWriter(folder, "train") as writer:
        writer.write(_meta(), frames)
    Manifest(shards=writer.entries).save(folder)
    return folder


def _members(folder: Path) -> dict[str, bytes]:
    with tarfile.open(folder / SHARD) as tar:
        return {info.name: tar.extractfile(info).read() for info in tar}  # type: ignore[union-attr]


def _rewritten(change: Callable[[tarfile.TarFile, dict[str, bytes]], None]) -> Build:
    """A dataset whose shard ``change`` writes anew from its members."""

    def build(folder: Path) -> Path:
        members = _members(_dataset(folder))
        with tarfile.open(folder / SHARD, "w") as tar:
            change(tar, members)
        return folder

    return build


def _add(tar: tarfile.TarFile, name: str, data: bytes = b"", **attributes: Any) -> None:
    info = tarfile.TarInfo(name)
    info.size = len(data)
    for key, value in attributes.items():
        setattr(info, key, value)
    tar.addfile(info, io.BytesIO(data))


def _as_they_are(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
    for name, content in members.items():
        _add(tar, name, content)


def _with(name: str, data: bytes = b"", **attributes: Any) -> Build:
    """The shard's members after one more."""

    def change(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
        _add(tar, name, data, **attributes)
        _as_they_are(tar, members)

    return _rewritten(change)


def _replaced(ending: str, data: Callable[[bytes], bytes]) -> Build:
    """The shard with other bytes in the members that end so."""

    def change(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
        for name, content in members.items():
            _add(tar, name, data(content) if name.endswith(ending) else content)

    return _rewritten(change)


def _claims_a_terabyte(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
    info = tarfile.TarInfo(next(iter(members)))
    info.size = 10**12
    tar.fileobj.write(info.tobuf(tarfile.GNU_FORMAT))  # type: ignore[union-attr]


def _cut(kept: Callable[[bytes], int]) -> Build:
    def build(folder: Path) -> Path:
        data = (_dataset(folder) / SHARD).read_bytes()
        (folder / SHARD).write_bytes(data[: kept(data)])
        return folder

    return build


def _many(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
    del members
    header = tarfile.TarInfo("a0.f00.pbr.exr").tobuf(tarfile.USTAR_FORMAT)
    for _ in range(100):
        tar.fileobj.write(header * 3000)  # type: ignore[union-attr]


def _long_name(tar: tarfile.TarFile, members: dict[str, bytes]) -> None:
    """A name of a gigabyte by GNU's extension: sparse on the disk, read into memory by Python's tarfile."""
    del members
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 2**30
    tar.fileobj.write(info.tobuf(tarfile.GNU_FORMAT))  # type: ignore[union-attr]
    tar.fileobj.seek(2**30, io.SEEK_CUR)  # type: ignore[union-attr]
    tar.fileobj.write(bytes(1024))  # type: ignore[union-attr]


def _other_meta(**entries: Any) -> Build:
    return _replaced("meta.json", lambda data: json.dumps({**json.loads(data), **entries}).encode())


def _compressed(folder: Path) -> Path:
    data = (_dataset(folder) / SHARD).read_bytes()
    return _overwritten(folder, SHARD, gzip.compress(data))


def _shards() -> dict[str, Build]:
    pickled = pickle.dumps(Explosive())
    return {
        GOOD: _dataset,
        "a name that leads out": _with("../../a1.f00.pbr.exr", b"x"),
        "an absolute name": _with("/tmp/a1.f00.pbr.exr", b"x"),
        "a name outside the schema": _with("a1.f00.secret.exr", b"x"),
        "a pickle": _with("a1.f00.pbr.pkl", pickled),
        "a pickle called an image": _replaced("pbr.exr", lambda _: pickled),
        "a symbolic link": _with("a1.f00.pbr.exr", type=tarfile.SYMTYPE, linkname="/etc/passwd"),
        "a hard link": _with("a1.f00.pbr.exr", type=tarfile.LNKTYPE, linkname="/etc/passwd"),
        "a device": _with("a1.f00.pbr.exr", type=tarfile.CHRTYPE),
        "a pipe": _with("a1.f00.pbr.exr", type=tarfile.FIFOTYPE),
        "a folder": _with("a1.f00.pbr.exr", type=tarfile.DIRTYPE),
        "compressed": _compressed,
        "a member of a terabyte": _rewritten(_claims_a_terabyte),
        "a name of a gigabyte": _rewritten(_long_name),
        "300,000 members": _rewritten(_many),
        "cut at a member's boundary": _cut(lambda data: data.rindex(b"a0.meta.json")),
        "cut in a member": _cut(lambda data: len(data) // 2),
        "a header of 10^6 x 10^6 pixels": _replaced("pbr.exr", lambda _: enormous_exr(10**6)),
        "pixels that are not numbers": _replaced("pbr.exr", lambda _: _nan_exr()),
        "an image that unpacks a thousandfold": _replaced("foreground.png", lambda _: enormous_png(30_000)),
        "metadata that are no JSON": _replaced("meta.json", lambda _: b"{" * 10_000),
        "metadata of another schema": _other_meta(schema_version=SCHEMA_VERSION + 1),
        "metadata of a billion frames": _other_meta(frames=10**9),
        "an exposure that is not finite": _replaced(
            "meta.json", lambda data: data.replace(b'"exposure":1.0', b'"exposure":NaN')
        ),
        "no tar at all": lambda folder: _overwritten(_dataset(folder), SHARD, bytes(range(256)) * 20),
    }


def _overwritten(folder: Path, name: str, data: bytes) -> Path:
    (folder / name).write_bytes(data)
    return folder


def _manifest(**change: Any) -> Build:
    """A dataset whose manifest says something else of its shard."""

    def build(folder: Path) -> Path:
        path = _dataset(folder) / "manifest.json"
        content = json.loads(path.read_bytes())
        content["shards"][0].update(change)
        path.write_text(json.dumps(content))
        return folder

    return build


def _sparse_manifest(folder: Path) -> Path:
    with (_dataset(folder) / "manifest.json").open("r+b") as file:
        file.truncate(2**33)
    return folder


def _manifests() -> dict[str, Build]:
    return {
        GOOD: _dataset,
        "a shard that lies elsewhere": _manifest(name="../../etc/passwd"),
        "a shard of an absolute path": _manifest(name="/etc/passwd"),
        "a shard that is a URL": _manifest(name="http://127.0.0.1:9/train-00000.tar"),
        "clips that are not there": _manifest(keys=["a0", "a1"], samples=2),
        "fewer clips than none": _manifest(samples=-1),
        "eight gigabytes": _sparse_manifest,
        "lists within lists": lambda folder: _overwritten(
            _dataset(folder), "manifest.json", b"[" * 10**6 + b"]" * 10**6
        ),
        "no JSON": lambda folder: _overwritten(_dataset(folder), "manifest.json", pickle.dumps(Explosive())),
    }


def enormous_png(side: int, unpacked: int = 999, text: bytes = b"") -> bytes:
    """A PNG of side x side pixels, of whose rows there are so many bytes of zeros, after a packed comment."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">2I5B", side, side, 8, 2, 0, 0, 0)
    comment = chunk(b"zTXt", b"comment\0\0" + zlib.compress(text)) if text else b""
    rows = chunk(b"IDAT", zlib.compress(bytes(unpacked)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + comment + rows


def enormous_exr(width: int, height: int | None = None) -> bytes:
    """An EXR whose header says so many pixels, as high as wide if nothing else is said, and holds a few."""
    data = encode_exr(np.zeros((SIDE, SIDE, 3), np.float32))
    window = struct.pack("<4i", 0, 0, SIDE - 1, SIDE - 1)
    return data.replace(window, struct.pack("<4i", 0, 0, width - 1, (height or width) - 1))


def _nan_exr() -> bytes:
    return encode_exr(np.full((SIDE, SIDE, 3), np.nan, np.float32), half=False)


def _file(name: str, data: bytes | Callable[[], bytes]) -> Build:
    def build(folder: Path) -> Path:
        (folder / name).write_bytes(data() if callable(data) else data)
        return folder / name

    return build


def _pictures() -> dict[str, Build]:
    program = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(executed) (w) file closefile\n"
    noise = generator(0, "hostile picture").random((SIDE, SIDE, 3), np.float32)
    radiance = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
    return {
        GOOD: _file("good.exr", lambda: encode_exr(np.zeros((SIDE, SIDE, 3), np.float32))),
        "EXR of 10^6 x 10^6": _file("big.exr", lambda: enormous_exr(10**6)),
        "EXR of negative size": _file("negative.exr", lambda: enormous_exr(-5)),
        "EXR that ends": _file("cut.exr", lambda: encode_exr(np.ones((64, 64, 3), np.float32))[:400]),
        "EXR of 2^31 pixels in a row": _file("wide.exr", lambda: enormous_exr(2**31 - 1, 1)),
        "EXR of half a gigabyte": _file("half.exr", lambda: enormous_exr(16384, 8192)),
        "EXR of a header": _file("head.exr", lambda: encode_exr(noise)[:60]),
        "PNG of 30,000 x 30,000": _file("big.png", lambda: enormous_png(30_000)),
        "PNG of 10^6 x 10^6": _file("huge.png", lambda: enormous_png(10**6)),
        "PNG that unpacks a thousandfold": _file("bomb.png", lambda: enormous_png(10_000, 50_000_000)),
        "PNG with a comment that does": _file("text.png", lambda: enormous_png(4, text=bytes(10**8))),
        "PNG that ends": _file("cut.png", lambda: encode_png(noise)[:-30]),
        "a GIF called PNG": _file("gif.png", b"GIF89a" + bytes(40)),
        "a JPEG of words": _file("text.jpg", b"\xff\xd8\xff\xe0 not a jpeg"),
        "HDR of 10^9 rows": _file("big.hdr", radiance + b"-Y 1000000000 +X 1000000000\n" + bytes(99)),
        "HDR of 10^400 rows": _file("digits.hdr", radiance + b"-Y " + b"9" * 400 + b" +X 4\n"),
        "HDR of half a gigabyte": _file("half.hdr", radiance + b"-Y 8192 +X 16384\n" + bytes(64)),
        "HDR that ends": _file("cut.hdr", radiance + b"-Y 100 +X 100\n" + bytes(64)),
        "HDR of a header without end": _file("text.hdr", b"#?RADIANCE\n" + b"a" * 100_000),
        "a program called PNG": _file("program.png", program),
        "a pickle called NumPy's": _file("map.npy", pickle.dumps(Explosive())),
    }


def _ply(head: str, body: bytes = b"") -> bytes:
    return f"ply\nformat {head}end_header\n".encode() + body


_FLOATS = "".join(f"property float {name}\n" for name in REQUIRED)


def _changed_surfels(**values: Any) -> Build:
    def build(folder: Path) -> Path:
        count = 4
        scene = {
            "means": np.zeros((count, 3), np.float32),
            "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            "log_scales": np.full((count, 2), -3, np.float32),
            "opacity_logits": np.full(count, 4, np.float32),
            "sh": np.zeros((count, 16, 3), np.float32),
            "base_color": np.full((count, 3), 0.5, np.float32),
            "roughness": np.full(count, 0.5, np.float32),
            "metallic": np.zeros(count, np.float32),
            "object_id": np.zeros(count, np.int32),
        }
        path = folder / "surfels.ply"
        GaussianScene(**scene, spacing=0.1).save(path)
        if values:
            file = PlyData.read(path)
            vertices = file["vertex"].data.copy()  # not the file's own pages
            for name, value in values.items():
                vertices[name] = value
            file["vertex"].data = vertices
            file.write(path)
        return path

    return build


def _surfels() -> dict[str, Build]:
    binary = "binary_little_endian 1.0\n"
    return {
        GOOD: _changed_surfels(),
        "10^12 vertices": _file("many.ply", _ply(f"{binary}element vertex {10**12}\n{_FLOATS}")),
        "10^12 vertices in words": _file("words.ply", _ply(f"ascii 1.0\nelement vertex {10**12}\n{_FLOATS}")),
        "10^12 faces": _file(
            "faces.ply",
            _ply(f"{binary}element vertex 0\n{_FLOATS}element face {10**12}\nproperty list uchar int i\n"),
        ),
        "fewer vertices than none": _file("minus.ply", _ply(f"ascii 1.0\nelement vertex -3\n{_FLOATS}")),
        "a header without end": _file("header.ply", b"ply\nformat ascii 1.0\n" + b"comment x\n" * 10**6),
        "places that are not numbers": _changed_surfels(x=np.nan),
        "zero quaternions": _changed_surfels(rot_0=0.0, rot_1=0.0, rot_2=0.0, rot_3=0.0),
        "a pickle": _file("pickle.ply", pickle.dumps(Explosive())),
    }


def _photo() -> bytes:
    return encode_png(generator(0, "hostile", "photo").random((SIDE, SIDE, 3), np.float32))


def _capture(
    top: Mapping[str, Any] | None = None,
    every: Mapping[str, Any] | None = None,
    files: Mapping[str, bytes | Callable[[], bytes]] | None = None,
    text: bytes | None = None,
) -> Build:
    """A capture of four photos: entries at its top, in every frame, other files, or another text."""

    def build(folder: Path) -> Path:
        (folder / "images").mkdir()
        frames = []
        for number in range(4):
            name = f"images/{number}.png"
            (folder / name).write_bytes(_photo())
            matrix = np.eye(4)
            matrix[:3, 3] = (number, 0, 3)
            frames.append({"file_path": name, "transform_matrix": matrix.tolist(), **(every or {})})
        content = {"fl_x": 12.0, "w": SIDE, "h": SIDE, "frames": frames, **(top or {})}
        (folder / "transforms.json").write_bytes(text or json.dumps(content).encode())
        for name, data in (files or {}).items():
            (folder / name).write_bytes(data() if callable(data) else data)
        return folder

    return build


def _all_photos(data: Callable[[], bytes]) -> Build:
    return _capture(files={f"images/{number}.png": data for number in range(4)})


def _colmap(**files: bytes) -> Build:
    """A COLMAP model with these files; the usual ones are of one camera and no photo."""

    def build(folder: Path) -> Path:
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        (folder / "images").mkdir()
        (folder / "images" / "0.png").write_bytes(_photo())
        camera = struct.pack("<Q", 1) + struct.pack("<iiQQ3d", 1, 0, SIDE, SIDE, 12.0, 6.0, 6.0)
        usual = {"cameras": camera, "images": struct.pack("<Q", 0), "points3D": struct.pack("<Q", 0)}
        for name, data in {**usual, **files}.items():
            (model / f"{name}.bin").write_bytes(data)
        return folder

    return build


def _captures() -> dict[str, Build]:
    points = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n"
    points += b"".join(f"property float {axis}\n".encode() for axis in "xyz") + b"end_header\n"
    not_a_number = [[float("nan")] * 4] * 4
    return {
        GOOD: _capture(),
        "photos outside its folder": _capture(every={"file_path": "../../../../etc/passwd"}),
        "photos of absolute paths": _capture(every={"file_path": "/etc/passwd"}),
        "photos of the net": _capture(every={"file_path": "http://127.0.0.1:9/a.png"}),
        "poses that are not numbers": _capture(every={"transform_matrix": not_a_number}),
        "a focal length of nothing": _capture(top={"fl_x": 0.0}),
        "photos of 30,000 x 30,000": _all_photos(lambda: enormous_png(30_000)),
        "photos that are pickles": _all_photos(lambda: pickle.dumps(Explosive())),
        "10^12 points": _capture(top={"ply_file_path": "points.ply"}, files={"points.ply": points}),
        "lists within lists": _capture(text=b'{"frames":' + b"[" * 10**6 + b"]" * 10**6 + b"}"),
        "a pickle for poses": _capture(text=pickle.dumps(Explosive())),
        "10^12 photos in COLMAP's file": _colmap(images=struct.pack("<Q", 10**12)),
        "10^12 cameras in COLMAP's file": _colmap(cameras=struct.pack("<Q", 10**12)),
    }


def _pickled_weights() -> bytes:
    import torch

    buffer = io.BytesIO()
    torch.save({"net.x": Explosive()}, buffer)
    return buffer.getvalue()


def _good_weights(folder: Path) -> Path:
    from tron.neural.configs import PixelMLPConfig
    from tron.neural.networks.pixel_mlp import PixelMLP
    from tron.neural.weights import save_renderer

    save_renderer(folder / "renderer.safetensors", PixelMLP(PixelMLPConfig()))
    return folder / "renderer.safetensors"


def _weights() -> dict[str, Build]:
    lies = b'{"a":{"dtype":"F32","shape":[1000000,1000000],"data_offsets":[0,4000000000000]}}'
    return {
        GOOD: _good_weights,
        "torch's pickle": _file("renderer.safetensors", _pickled_weights),
        "a header of 2^62 bytes": _file("renderer.safetensors", struct.pack("<Q", 2**62) + b"{}"),
        "a tensor of four terabytes": _file("renderer.safetensors", struct.pack("<Q", len(lies)) + lies),
    }


def _recipes() -> dict[str, Build]:
    anchors = ["a: &a [x,x,x,x,x,x,x,x,x,x]"]
    for before, here in zip("abcdefgh", "bcdefghi"):
        anchors.append(f"{here}: &{here} [{','.join([f'*{before}'] * 10)}]")
    return {
        GOOD: _file("config.yaml", b"seed: 3\n"),
        "a call in YAML": _file(
            "config.yaml", f"a: !!python/object/apply:os.system ['touch {CANARY}']\n".encode()
        ),
        "no mapping": _file("config.yaml", b"[1, 2]\n"),
        "bytes that are no text": _file("config.yaml", bytes(range(128, 256))),
    }


SECONDS = 1.0
MEGABYTES = 200.0
READER = Path(__file__).with_name("hostile_reader.py")
PATIENCE = 600.0
"""Seconds after which a child counts as hung."""


@dataclass(frozen=True)
class Attempt:
    """One file as its reader met it.

    Attributes:
        said: the error's text; None where the file was taken.
        seconds: of processor time.
        megabytes: by which the peak of resident memory grew.
        executed: something in the file was run.
    """

    kind: str
    what: str
    said: str | None
    seconds: float
    megabytes: float
    executed: bool

    def problem(self) -> str | None:
        """Why the file does not count as refused; None where it does."""
        if self.executed:
            return "it was executed"
        if self.said is None:
            return "it was taken"
        if "\n" in self.said:
            return "more than one line"
        if self.seconds > SECONDS:
            return f"it took {self.seconds:.1f} s"
        if self.megabytes > MEGABYTES:
            return f"it took {self.megabytes:.0f} MB"
        return None


def read_all(files: Mapping[str, Mapping[str, Build]], folder: Path) -> list[Attempt]:
    """Write every file and have it read, kind by kind.

    Files after one that ended the child are given to a new one, which begins with the good one of their kind.

    Raises:
        TronError: a good file was refused, so that refusals say nothing.
    """
    given: list[tuple[str, str, Path]] = []
    for kind, builders in files.items():
        for number, (what, build) in enumerate(builders.items()):
            place = folder / kind / f"{number:02d}"
            place.mkdir(parents=True)
            given.append((kind, what, build(place)))
    good = {kind: (kind, what, path) for kind, what, path in given if what == GOOD}
    attempts: list[Attempt] = []
    while left := given[len(attempts) :]:
        kind, what, _ = left[0]
        first = [] if what == GOOD else [good[kind]]
        said = _child([*first, *left])[len(first) :]
        attempts += [Attempt(*each[:2], **line) for each, line in zip(left, said)]
        if len(said) < len(left):
            kind, what, _ = left[len(said)]
            attempts.append(Attempt(kind, f"{what} (the reader died)", None, 0.0, 0.0, False))
    for each in attempts:
        if each.what == GOOD and each.said is not None:
            raise TronError(f"a good {each.kind} is refused: {each.said}", good[each.kind][2])
    shutil.rmtree(folder)
    return [each for each in attempts if each.what != GOOD]


def _child(given: Sequence[tuple[str, str, Path]]) -> list[dict]:
    words = [sys.executable, str(READER), CANARY, *(f"{kind}={path}" for kind, _, path in given)]
    try:
        output = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False).stdout
    except subprocess.TimeoutExpired as error:
        output = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
    return [json.loads(line[1:]) for line in output.splitlines() if line.startswith("@")]


def test_hostile_files_are_refused_in_a_line_a_second_and_little_memory(tmp_path: Path) -> None:
    files = hostile_files()
    attempts = read_all(files, tmp_path / "files")
    assert len(attempts) == sum(map(len, files.values())) - len(files)
    problems = [(each.kind, each.what, each.problem()) for each in attempts]
    assert [problem for problem in problems if problem[2]] == []


def test_a_reader_that_refuses_everything_has_refused_nothing(tmp_path: Path) -> None:
    files = hostile_files()["recipe"]
    files[GOOD] = files["no mapping"]
    with pytest.raises(TronError, match="a good recipe is refused"):
        read_all({"recipe": files}, tmp_path / "files")


def test_only_one_cheap_line_without_execution_counts() -> None:
    good = {"said": "no", "seconds": 0.1, "megabytes": 3.0, "executed": False}
    assert Attempt("a", "b", **good).problem() is None
    for change in (
        {"said": None},
        {"said": "two\nlines"},
        {"seconds": 1.5},
        {"megabytes": 201.0},
        {"executed": True},
    ):
        assert Attempt("a", "b", **{**good, **change}).problem() is not None

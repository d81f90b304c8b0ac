"""Shards: what goes in comes out, the bytes are a function of the clips, and damage or malice is found."""

import io
import json
import re
import shutil
import tarfile
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.shards import MEMBERS, ClipMeta, Manifest, ShardWriter, clip_members, read_clips, verify
from tron.shards.reader import decode_clip, decode_meta, group_clips, tar_files
from tron.shards.schema import SCHEMA_VERSION, members_table, meta_schema, parse_name


def meta(key: str, split: str = "train", frames: int = 2) -> ClipMeta:
    return ClipMeta(
        key=key,
        scene=key[:4],
        light="sun-0",
        light_family="sun",
        split=split,
        frames=frames,
        width=8,
        height=6,
        cameras=[Camera.look_at((0, -4, 1), (0, 0, 0), fov_deg=35, width=8, height=6).to_dict()] * frames,  # type: ignore[arg-type]
        exposure=0.37,
        color_space={"rgb": "linear"},
        seeds={"scene": 7},
    )


def frames(key: str, count: int = 2, reference: bool = False) -> list[dict[str, np.ndarray]]:
    random = seeds.generator(0, "shards", key)
    made = []
    for _ in range(count):
        frame = {}
        for name in clip_members(reference):
            member = MEMBERS[name]
            image = random.random((6, 8, member.channels), dtype=np.float32)
            frame[name] = image.round() if member.extension == "png" else image * 3
        made.append(frame)
    return made


def write(folder: Path, keys=("a0", "a1", "a2"), per_shard: int = 2, reference: bool = False) -> Manifest:
    with ShardWriter(folder, "train", per_shard) as writer:
        for key in keys:
            writer.write(meta(key), frames(key, reference=reference))
    manifest = Manifest(config_sha256="0" * 64, shards=writer.entries)
    manifest.save(folder)
    return manifest


def test_round_trip_is_exact_up_to_half_precision(tmp_path):
    write(tmp_path, reference=True)
    clips = list(read_clips(tmp_path, "train"))
    assert [clip.meta.key for clip in clips] == ["a0", "a1", "a2"]
    for clip in clips:
        assert clip.meta == meta(clip.meta.key)
        assert set(clip.frames) == set(MEMBERS)
        for number, frame in enumerate(frames(clip.meta.key, reference=True)):
            for name, image in frame.items():
                member = MEMBERS[name]
                expected = image.astype(np.float16) if member.bytes == 2 else image
                np.testing.assert_array_equal(clip.frames[name][number], expected.astype(np.float32), name)


def test_bytes_depend_on_the_clips_alone(tmp_path):
    for folder in ("one", "two"):
        write(tmp_path / folder)
    for name in ("train-00000.tar", "train-00001.tar", "manifest.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    with tarfile.open(tmp_path / "one" / "train-00000.tar") as tar:
        assert {(i.mtime, i.uid, i.gid, i.uname, i.mode) for i in tar} == {(0, 0, 0, "", 0o644)}


def test_the_manifest_accounts_for_every_byte(tmp_path):
    import hashlib

    manifest = write(tmp_path)
    assert [entry.samples for entry in manifest.shards] == [2, 1]
    assert Manifest.load(tmp_path) == manifest
    for entry in manifest.shards:
        data = (tmp_path / entry.name).read_bytes()
        assert (entry.bytes, entry.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    assert verify(tmp_path) == []


def test_only_wanted_members_and_frames_are_decoded(tmp_path):
    write(tmp_path)
    files = dict(group_clips(tar_files(tmp_path / "train-00000.tar", ("rgb",))))["a0"]
    assert set(files) == {"f00.rgb.exr", "f01.rgb.exr", "meta.json"}
    files["f00.rgb.exr"] = b"not an image: decoding it would fail"
    clip = decode_clip(files, ("rgb",), [1])
    np.testing.assert_array_equal(
        clip.frames["rgb"][0], frames("a0")[1]["rgb"].astype(np.float16).astype(np.float32)
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_and_leave_nothing(tmp_path, value):
    bad = frames("a0")
    bad[1]["irradiance"][2, 3, 1] = value
    with ShardWriter(tmp_path, "train") as writer:
        with pytest.raises(TronError, match=r"a0 frame 1 irradiance holds 1 values"):
            writer.write(meta("a0"), bad)
        writer.write(meta("a1"), frames("a1"))
    assert writer.entries[0].keys == ["a1"]
    assert [key for key, _ in group_clips(tar_files(tmp_path / "train-00000.tar"))] == ["a1"]


def test_a_sun_beyond_half_precision_is_stored_as_its_largest_value(tmp_path):
    bright = frames("a0")
    bright[0]["pbr"][0, 0] = 2e5
    with ShardWriter(tmp_path, "train") as writer:
        writer.write(meta("a0"), bright)
    files = dict(group_clips(tar_files(tmp_path / "train-00000.tar")))["a0"]
    assert decode_clip(files).frames["pbr"][0, 0, 0].tolist() == [65504.0] * 3


@pytest.mark.parametrize(
    "spoil",
    [
        lambda f: f[0].pop("mask"),
        lambda f: f[0].update(extra=f[0]["pbr"]),
        lambda f: f[0].update(pbr=f[0]["pbr"][:4]),
        lambda f: f[0].update(normal=f[0]["pbr"]),  # one reference member without the others
        lambda f: f.pop(),
    ],
)
def test_a_clip_that_is_not_whole_is_refused(tmp_path, spoil):
    clip = frames("a0")
    spoil(clip)
    with ShardWriter(tmp_path, "train") as writer, pytest.raises(TronError):
        writer.write(meta("a0"), clip)
    assert list(tmp_path.iterdir()) == []


def test_a_clip_is_written_once_and_in_its_own_split(tmp_path):
    with ShardWriter(tmp_path, "train", 1) as writer:
        writer.write(meta("a0"), frames("a0"))
        with pytest.raises(TronError, match="twice"):
            writer.write(meta("a0"), frames("a0"))
        with pytest.raises(TronError, match="split"):
            writer.write(meta("b0", split="test"), frames("b0"))


def test_an_exception_drops_the_shard_in_hand_and_keeps_whole_ones(tmp_path):
    def interrupted() -> None:
        with ShardWriter(tmp_path, "train", 2) as writer:
            for key in ("a0", "a1", "a2"):
                writer.write(meta(key), frames(key))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["train-00000.idx", "train-00000.tar"]


@pytest.mark.parametrize("key", ["a.b", "", "a/b", "ä", "x" * 61])
def test_keys_that_webdataset_would_misread_are_refused(key):
    with pytest.raises(ValueError, match="key"):
        meta(key)


def test_verify_finds_truncation_at_any_point(tmp_path):
    write(tmp_path / "whole", per_shard=3)
    data = (tmp_path / "whole" / "train-00000.tar").read_bytes()
    with tarfile.open(tmp_path / "whole" / "train-00000.tar") as tar:
        members = list(tar)
    starts = [member.offset for member in members]
    cuts = {
        0,
        1,
        511,
        512,
        len(data) - 1,
        len(data) - 10240,
        *starts[:20],
        starts[-1],
        members[-1].offset_data + 3,
    }
    for cut in sorted(cuts):
        folder = tmp_path / f"cut{cut}"
        shutil.copytree(tmp_path / "whole", folder)
        (folder / "train-00000.tar").write_bytes(data[:cut])
        problems = verify(folder)
        assert problems, f"cut at {cut}"
        assert all(problem.startswith("train-00000.tar") for problem in problems)
        lost = [m.name.split(".")[0] for m in members if m.offset_data + m.size > cut]
        for key in set(lost):
            assert any(f" {key}: " in problem for problem in problems) or "shard" in problems[-1], (cut, key)


def test_truncated_shards_are_not_read_as_if_whole(tmp_path):
    write(tmp_path, per_shard=3)
    path = tmp_path / "train-00000.tar"
    with tarfile.open(path) as tar:
        boundary = next(member.offset for member in tar if member.name.startswith("a2."))
    path.write_bytes(path.read_bytes()[:boundary])  # ends without an error in tarfile
    with pytest.raises(TronError, match="holds 2 clips, the manifest names 3"):
        list(read_clips(tmp_path, "train"))


def test_verify_finds_a_flipped_bit_in_a_place_that_decodes(tmp_path):
    write(tmp_path)
    path = tmp_path / "train-00000.tar"
    data = bytearray(path.read_bytes())
    where = data.rindex(b'"exposure":0.37') + 13
    data[where] ^= 1
    path.write_bytes(data)
    assert any("sha256 differs" in problem for problem in verify(tmp_path))


def rewritten(folder: Path, change) -> list[str]:
    """Problems after a shard's members went through `change` and the manifest was made to agree."""
    import hashlib

    manifest = write(folder)
    path = folder / "train-00000.tar"
    with tarfile.open(path) as tar:
        members = [(m.name, tar.extractfile(m).read()) for m in tar]  # type: ignore[union-attr]
    with tarfile.open(path, "w") as tar:
        for name, data in change(members):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    data = path.read_bytes()
    first = manifest.shards[0].model_copy(
        update={"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    )
    manifest.model_copy(update={"shards": [first, *manifest.shards[1:]]}).save(folder)
    return verify(folder)


def test_verify_names_missing_and_repeated_members_and_clips(tmp_path):
    gone = rewritten(tmp_path / "1", lambda m: [x for x in m if x[0] != "a1.f01.irradiance.exr"])
    assert any("a1" in problem and "f01.irradiance.exr" in problem for problem in gone)
    twice = rewritten(tmp_path / "2", lambda m: [m[0], *m])
    assert any("f00.pbr.exr is there twice" in problem for problem in twice)
    lost = rewritten(tmp_path / "3", lambda m: [x for x in m if not x[0].startswith("a1.")])
    assert any("a1: clip is missing" in problem for problem in lost)
    no_meta = rewritten(tmp_path / "4", lambda m: [x for x in m if x[0] != "a0.meta.json"])
    assert any("a0: no meta.json" in problem for problem in no_meta)


def test_verify_finds_stray_and_missing_shards(tmp_path):
    write(tmp_path)
    (tmp_path / "train-00001.tar").rename(tmp_path / "train-00007.tar")
    problems = verify(tmp_path)
    assert any(p.startswith("train-00001.tar: missing") for p in problems)
    assert any(p.startswith("train-00007.tar: not in the manifest") for p in problems)


def test_names_outside_the_schema_are_refused():
    assert parse_name("s01-l2.f00.pbr.exr") == ("s01-l2", 0, "pbr")
    assert parse_name("s01-l2.meta.json") == ("s01-l2", None, "meta")
    for name in (
        "s.f00.pbr.png",
        "s.f00.pbr",
        "s.f0.pbr.exr",
        "s.f00.foreground.exr",
        "f00.pbr.exr",
        "s.json",
    ):
        with pytest.raises(TronError):
            parse_name(name)


@pytest.mark.parametrize("text", ["", "[]", "{}" * 2, '{"shards": 3}', '{"schema_version": 99}'])
def test_a_damaged_manifest_is_one_clear_line(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(TronError) as caught:
        Manifest.load(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", range(1, SCHEMA_VERSION))
def test_clips_of_an_older_schema_are_refused_by_its_name(version):
    old = meta("a0").model_copy(update={"schema_version": version})
    said = rf"dataset of schema {version}, this program reads schema {SCHEMA_VERSION} \(clip a0\): make it"
    with pytest.raises(TronError, match=said):
        decode_meta(old.model_dump_json().encode())


def test_an_absent_split_names_those_there_are(tmp_path):
    write(tmp_path)
    with pytest.raises(TronError, match=r"no split 'test'.*train"):
        list(read_clips(tmp_path, "test"))
    with pytest.raises(TronError, match="no dataset folder"):
        list(read_clips(tmp_path / "nowhere", "test"))


def test_the_table_of_the_documentation_is_the_schemas():
    text = (Path(__file__).resolve().parents[3] / "docs" / "guides" / "datasets.md").read_text()
    begin, end = "<!-- tron.shards.schema.members_table() -->\n", "<!-- end -->"
    assert text.split(begin)[1].split(end)[0] == members_table()


def test_the_loader_of_the_page_reads_every_member_without_us(tmp_path):
    page = (Path(__file__).parents[3] / "docs/guides/datasets.md").read_text("utf-8")
    (loader,) = re.findall(r"## Without TRON\n.*?```python\n(.*?)```", page, re.DOTALL)
    assert len([line for line in loader.splitlines() if line]) <= 26
    assert "tron" not in loader
    names: dict[str, Any] = {}
    exec(compile(loader, "datasets.md", "exec"), names)
    manifest = write(tmp_path, reference=True)
    read = [clip for entry in manifest.shards for clip in names["clips"](tmp_path / entry.name)]
    ours = list(read_clips(tmp_path, "train"))
    assert len(read) == len(ours) == 3
    for (meta, members), clip in zip(read, ours):
        assert ClipMeta.model_validate(meta) == clip.meta
        assert members.keys() == clip.frames.keys() == set(clip_members(reference=True))
        for name, image in members.items():
            np.testing.assert_array_equal(image, clip.frames[name])


CAMERA = meta("a").cameras[0]


@pytest.mark.parametrize(
    "change",
    [
        {"key": "a.b"},
        {"key": None},
        {"split": "Train"},
        {"light_family": ""},
        {"frames": 0},
        {"width": 8.5},
        {"exposure": 0},
        {"cameras": [{}]},
        {"cameras": [{**CAMERA, "fx": -1}]},
        {"cameras": [{**CAMERA, "world_to_camera": [[1, 0, 0]] * 4}]},
        {"cameras": [{**CAMERA, "skew": 0.0}]},
        {"color_space": {"rgb": "srgb"}},
        {"seeds": {"scene": "seven"}},
        {"unknown": 1},
    ],
)
def test_the_schema_and_the_reader_refuse_the_same_metadata(change):
    """A second library, jsonschema, reads the schema that lies in every dataset."""
    good = json.loads(meta("a").model_dump_json())
    check = jsonschema.Draft202012Validator(json.loads(json.dumps(meta_schema())))
    check.check_schema(check.schema)
    assert check.is_valid(good)
    assert not check.is_valid(good | change)
    with pytest.raises(TronError, match=r"meta\.json is damaged"):
        decode_meta(json.dumps(good | change).encode())

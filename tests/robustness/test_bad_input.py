"""What a user gets wrong costs one line that says what, where and how to mend it, and leaves nothing behind.

Each command is run in this process, from its real entry point: starting Python with torch costs seconds.
"""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import get_object

from tron.gaussians.scene import GaussianScene
from tron.shading.environments.environment import EnvironmentMap
from tron.shards.schema import SCHEMA_VERSION

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]

# Enough to get past the checks of keys; {inputs} is the folder that the fixture below fills.
COMPLETE = {
    "tron-datagen": ["experiment=demo"],
    "tron-reconstruct": ["capture={inputs}/empty"],
    "tron-train": ["dataset={inputs}/empty"],
    "tron-eval": ["dataset={inputs}/empty", "renderer={inputs}/text.safetensors"],
    "tron-relight": ["scene={inputs}/good.ply", "environment={inputs}/good.exr"],
    "tron-edit": ["scene={inputs}/good.ply", "edits={inputs}/good.yaml"],
    "tron-bake": ["scene={inputs}/good.ply", "environment={inputs}/good.exr"],
    "tron-environment": ["environment={inputs}/good.exr"],
    "tron-export": ["scene={inputs}/good.ply"],
    "tron-view": ["scene={inputs}/good.ply", "environments={inputs}/good.exr"],
}
WRITES: dict[str, str] = dict.fromkeys(
    ("tron-edit", "tron-bake", "tron-export", "tron-environment"), "output=out.ply"
)
"""Of commands that write no folder."""

BAD_FILES = [
    ("tron-edit", ["scene={inputs}/absent.ply"], ["file not found", "absent.ply"]),
    ("tron-edit", ["scene={inputs}/text.ply"], ["text.ply"]),
    ("tron-edit", ["scene={inputs}/cat.splat"], ["antimatter15", "splat-transform cat.splat cat.ply"]),
    ("tron-edit", ["edits={inputs}/text.ply"], ["no edits found", "text.ply"]),
    ("tron-edit", ["edits={inputs}/empty"], ["is a folder", "empty"]),
    ("tron-edit", ["edits={inputs}/walk.yaml"], ["edit 1: remove", "there is no object 9"]),
    ("tron-edit", ["edits=[{inputs}/good.yaml,{inputs}/good.yaml]"], ["object 0 is named by both lists"]),
    ("tron-edit", ["cameras={inputs}/text.hdr"], ["text.hdr"]),
    ("tron-edit", ["cameras={inputs}/empty"], ["no cameras.json and no transforms.json", "empty"]),
    ("tron-edit", ["output={inputs}/good.ply"], ["output is the scene itself"]),
    ("tron-edit", ["output=cut.obj"], ["output is no PLY", "cut.obj"]),
    ("tron-bake", ["scene={inputs}/absent.ply"], ["file not found", "absent.ply"]),
    ("tron-bake", ["scene={inputs}/text.ply"], ["text.ply"]),
    ("tron-bake", ["environment={inputs}/text.hdr"], ["text.hdr"]),
    ("tron-bake", ["environment={inputs}/empty"], ["no six faces", "empty"]),
    ("tron-bake", ["output={inputs}/good.ply"], ["output is the scene itself"]),
    ("tron-bake", ["output=cut.obj"], ["does not say a format", "cut.obj", ".spz"]),
    ("tron-export", ["scene={inputs}/cat.sog"], ["cat.sog"]),
    ("tron-export", ["output=cut.obj"], ["cut.obj", ".spz"]),
    ("tron-export", ["output={inputs}/good.ply"], ["output is the scene itself"]),
    ("tron-view", ["scene={inputs}/text.ply"], ["text.ply"]),
    ("tron-view", ["environments={inputs}/empty"], ["holds no environment map", "empty"]),
    ("tron-view", ["environments={inputs}/absent"], ["there is no such folder", "absent"]),
    ("tron-view", ["environments={inputs}/text.hdr"], ["text.hdr"]),
    ("tron-view", ["models={inputs}/empty"], ["holds no PLY", "empty"]),
    ("tron-view", ["output_dir={inputs}/good.ply"], ["output_dir is a file"]),
    ("tron-relight", ["scene={inputs}/empty"], ["empty"]),
    ("tron-relight", ["scene={inputs}/text.ply"], ["text.ply"]),
    ("tron-relight", ["scene={inputs}/points.ply"], ["points.ply"]),
    ("tron-relight", ["environment={inputs}/text.hdr"], ["text.hdr"]),
    ("tron-relight", ["trajectory=keyframes"], ["cameras=FILE"]),
    ("tron-relight", ["environment={inputs}/text.xyz"], ["text.xyz"]),
    ("tron-relight", ["environment={inputs}/walk.mp4"], ["a video cannot hold", "walk.mp4"]),
    ("tron-relight", ["scene={inputs}/walk.mp4"], ["a video", "tron-reconstruct capture=walk.mp4"]),
    ("tron-relight", ["scene={inputs}/cat.splat"], ["antimatter15", "splat-transform cat.splat cat.ply"]),
    ("tron-relight", ["scene={inputs}/cat.spz"], ["Niantic", "by what it begins with"]),
    ("tron-relight", ["scene={inputs}/cat.compressed.ply"], ["PlayCanvas", "cat.compressed.ply cat.ply"]),
    ("tron-relight", ["checkpoint={inputs}/text.safetensors"], ["text.safe"]),
    ("tron-train", ["dataset={inputs}/absent"], ["absent"]),
    ("tron-train", ["dataset={inputs}/empty"], ["empty"]),
    ("tron-train", ["dataset={inputs}/text.ply"], ["text.ply"]),
    ("tron-eval", ["dataset={inputs}/absent"], ["absent"]),
    ("tron-eval", ["dataset={inputs}/empty"], ["empty"]),
    ("tron-datagen", ["assets={inputs}/absent"], ["absent"]),
    ("tron-datagen", ["environments={inputs}/absent"], ["absent"]),
    ("tron-datagen", ["mode=validate"], ["out"]),
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that are fine, hostile in the simplest way, or absent."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "empty").mkdir()
    for name in (
        "text.ply",
        "text.hdr",
        "text.xyz",
        "text.safetensors",
        "walk.mp4",
        "cat.splat",
        "cat.spz",
        "cat.sog",
    ):
        (folder / name).write_text("not what the name says\n")
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (folder / "points.ply").write_text(header + "end_header\n0 0 0\n")
    packed = "element chunk 1\nproperty float min_x\nelement vertex 1\nproperty uint packed_position\n"
    body = "end_header\n" + 8 * "x"
    (folder / "cat.compressed.ply").write_text(f"ply\nformat binary_little_endian 1.0\n{packed}{body}")
    one_surfel().save(folder / "good.ply")
    (folder / "good.yaml").write_text("- {action: material, select: {object: 0}, metallic: 1}\n")
    (folder / "walk.yaml").write_text("- {action: remove, select: {object: 9}}\n")
    EnvironmentMap.constant(1.0).save(folder / "good.exr")
    return folder


def one_surfel() -> GaussianScene:
    return GaussianScene(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        log_scales=np.full((1, 2), -3, np.float32),
        opacity_logits=np.full(1, 4, np.float32),
        sh=np.zeros((1, 16, 3), np.float32),
        base_color=np.full((1, 3), 0.5, np.float32),
        roughness=np.full(1, 0.5, np.float32),
        metallic=np.zeros(1, np.float32),
        object_id=np.zeros(1, np.int32),
        spacing=0.1,
    )


@pytest.fixture
def run(inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    """Runs a command in an empty folder, to write out; returns the one line it must have printed."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, *arguments: str) -> str:
        cli = get_object(SCRIPTS[name].replace(":", "."))
        capsys.readouterr()
        asked = [each.format(inputs=inputs) for each in arguments]
        with pytest.raises(SystemExit) as stop:
            cli([WRITES.get(name, "output_dir=out"), *asked])
        out, err = capsys.readouterr()
        assert stop.value.code == 2, err
        assert out == ""
        assert len(err.splitlines()) == 1, err
        assert err.startswith(f"{name}: ")
        left = {path.name for path in tmp_path.rglob("*") if not path.is_dir()}
        assert left <= {".tron.lock"}  # a lock cannot be removed without a race; it holds no result
        return err

    return run


def test_every_command_goes_through_the_one_door(run):
    """What that says of a mistake is in tests/tron/cli/test_command_line.py."""
    for name in sorted(SCRIPTS):
        key = WRITES.get(name, "output_dir=out").partition("=")[0]
        mistyped = key.replace("put", "ptu")
        assert f"'{mistyped}': did you mean '{key}'?" in run(name, *COMPLETE[name], f"{mistyped}=x")


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("tron-relight", ["bounces=0", "reflections=4"]),
        ("tron-relight", ["fidelity=paper", "reflections=4"]),
        ("tron-datagen", ["bounces=0", "reflections=4"]),
    ],
)
def test_reflections_of_light_that_does_not_bounce_are_refused(run, name, arguments):
    line = run(name, *COMPLETE[name], *arguments)
    assert "reflections=4" in line
    assert "bounces=0" in line


@pytest.mark.parametrize(
    ("name", "arguments", "named"),
    BAD_FILES,
    ids=lambda value: "-".join(value) if isinstance(value, list) else value,
)
def test_a_bad_file_is_named(run, variant, name, arguments, named):
    line = run(name, *COMPLETE[name], *arguments)
    assert [each for each in named if each not in line] == [], line


@pytest.mark.parametrize(
    "name, kept",
    [
        ("tron-train", ["manifest.json"]),
        ("tron-eval", ["manifest.json"]),
        ("tron-datagen validate", ["manifest.json"]),
        ("tron-datagen make", ["config.yaml", "manifest.json"]),
        ("tron-datagen make", ["config.yaml"]),
    ],
)
@pytest.mark.parametrize("version", [1, SCHEMA_VERSION - 1])
def test_a_dataset_of_an_older_schema_is_refused_by_its_name(variant, version, name, kept, tmp_path, capsys):
    """Its files, as that version wrote them; config.yaml alone is a run killed half-way."""
    old = tmp_path / "old"
    old.mkdir()
    if "manifest.json" in kept:
        empty = {"schema_version": version, "config_sha256": "", "shards": []}
        (old / "manifest.json").write_text(json.dumps(empty))
    if "config.yaml" in kept:
        (old / "config.yaml").write_text(f"schema: {version}\nrecipe: {{}}\nscenes: {{test: 1}}\n")
    command, _, mode = name.partition(" ")
    arguments = {
        "": [f"dataset={old}", f"output_dir={tmp_path / 'out'}"],
        "validate": ["mode=validate", f"output_dir={old}"],
        "make": ["experiment=demo", f"output_dir={old}"],
    }[mode]
    with pytest.raises(SystemExit) as stop:
        get_object(SCRIPTS[command].replace(":", "."))(arguments)
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert err == (
        f"{command}: dataset of schema {version}, this program reads schema {SCHEMA_VERSION} ({old}): "
        "make it again in a new folder with the tron-datagen command of its README.md or card.md\n"
    )
    assert sorted(path.name for path in old.iterdir() if path.name != ".tron.lock") == kept

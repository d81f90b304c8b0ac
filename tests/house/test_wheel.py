"""The wheel carries our packages and nothing else; its commands import ours, and need their extras alone."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.io.images import read_image
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tron", "conf", "datagen", "train", "eval")
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the sdist, and that from a copy: setuptools leaves build/ and *.egg-info beside sources."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    (source / "outputs").mkdir()
    (source / "outputs" / "__init__.py").touch()  # a package beside ours that must stay outside
    target = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, "-m", "build", "--no-isolation", "--outdir", target, source)
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment with the wheel alone; dependencies come from this one, behind it: its folder."""
    folder = make_environment(wheel, tmp_path_factory.mktemp("clean"))
    dependencies = sysconfig.get_path("purelib")
    (packages_of(folder) / "dependencies.pth").write_text(f"import sys; sys.path.append({dependencies!r})\n")
    return folder


@pytest.fixture(scope="module")
def smallest(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment after `pip install tron-relight[relight]`, without the network: its folder.

    What pip would bring is linked from this environment: the extra's requirements and theirs, as the wheels'
    metadata name them. What nothing asks for is not there.
    """
    folder = make_environment(wheel, tmp_path_factory.mktemp("smallest"))
    (own,) = importlib.metadata.distributions(name="tron-relight", path=[str(packages_of(folder))])
    for distribution in required(own, "relight"):
        for name in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            link = packages_of(folder) / name
            if not link.exists():
                link.symlink_to(Path(str(distribution.locate_file(name))))
    return folder


def make_environment(wheel: Path, folder: Path) -> Path:
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    _run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    return folder


def packages_of(environment: Path) -> Path:
    return environment / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"


def required(own: importlib.metadata.Distribution, extra: str) -> list[importlib.metadata.Distribution]:
    """Distributions that pip installs for an extra, found among those installed here."""
    found: dict[str, importlib.metadata.Distribution] = {}
    done, todo = set(), [(own, extra), (own, "")]
    while todo:
        distribution, chosen = todo.pop()
        for each in map(Requirement, distribution.requires or ()):
            if each.marker is None or each.marker.evaluate({"extra": chosen}):
                name = canonicalize_name(each.name)
                found.setdefault(name, importlib.metadata.distribution(name))
                for inner in {"", *each.extras}:
                    if (name, inner) not in done:
                        done.add((name, inner))
                        todo.append((found[name], inner))
    return list(found.values())


def test_the_wheel_holds_every_module_and_data_file_and_nothing_else(wheel: Path):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = {path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()}
    expected = {str(path.relative_to(ROOT)) for path in files if "__pycache__" not in path.parts}
    assert names == expected


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_a_command_imports_ours_beside_decoys(installed: Path, tmp_path: Path, command: str):
    for name in PACKAGES:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a decoy was imported')\n")
    shown = start(installed, command, "--help", "all", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert f"usage: {command}" in shown.stdout
    said = start(installed, "python", "-P", "-c", "import train.cli as m; print(m.__file__)", cwd=tmp_path)
    assert Path(said.stdout.strip()).is_relative_to(installed)


HIDDEN = [
    *((command, "conf.py") for command in sorted(COMMANDS)),
    *((f"tron-{name}", f"{name}.py") for name in ("train", "eval", "datagen")),
    ("tron-relight", "conf/__init__.py"),
]


@pytest.mark.parametrize(("command", "decoy"), [*HIDDEN, ("tron-relight", "train.py")])
def test_a_foreign_file_of_one_of_our_names_is_one_clear_line(
    installed: Path, tmp_path: Path, command: str, decoy: str
):
    (tmp_path / decoy).parent.mkdir(exist_ok=True)
    (tmp_path / decoy).write_text("raise SystemExit('a decoy was imported')\n")
    (tmp_path / "data").mkdir()  # a folder without __init__.py hides nothing
    refused = start(installed, command, "--help", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    if (command, decoy) not in HIDDEN:  # nothing imports it
        assert refused.returncode == 0, refused.stderr
        return
    hidden = decoy.partition("/")[0]
    assert refused.returncode == 2
    assert refused.stdout == ""
    (line,) = refused.stderr.splitlines()
    assert line.startswith(f"{command}: this file hides TRON's own package '{hidden.removesuffix('.py')}'")
    assert str(tmp_path / hidden) in line
    assert "rename it" in line


def test_a_module_run_beside_a_foreign_conf_says_so_too(installed: Path, tmp_path: Path):
    """`python -m` puts the current folder first on the path."""
    (tmp_path / "conf.py").touch()
    refused = start(installed, "python", "-m", "tron.apps.relight.cli", "--help", cwd=tmp_path)
    assert refused.returncode == 2
    (line,) = refused.stderr.splitlines()
    assert line.startswith("tron-relight: this file hides TRON's own package 'conf'")


def test_a_scene_is_relit_without_torch_and_lightning(smallest: Path, tmp_path: Path):
    absent = ("torch", "lightning", "dask", "webdataset", "diffusers", "transformers", "pycolmap", "trimesh")
    program = f"from importlib.util import find_spec; print([n for n in {absent} if find_spec(n)])"
    found = start(smallest, "python", "-P", "-c", program, cwd=tmp_path).stdout
    assert found.strip() == "[]"
    make_ball().save(tmp_path / "ball.ply")
    EnvironmentMap.constant(1.0).save(tmp_path / "white.hdr")
    arguments = ["scene=ball.ply", "environment=white.hdr", "output_dir=out", "frames=2"]
    done = start(smallest, "tron-relight", *arguments, "width=32", "height=32", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    picture = read_image(tmp_path / "out" / "frames" / "0000.relit.png")
    middle, corner = picture[14:18, 14:18].mean(axis=(0, 1)), picture[0, 0]
    assert middle[0] > middle[2] + 0.1, "the ball is red"
    assert np.ptp(corner) < 0.02, "the sky is white"
    assert (tmp_path / "out" / "relit.mp4").exists()


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        ("tron-train", [], ["lightning", "torch", "pip install 'tron-relight[train]'"]),
        ("tron-datagen", [], ["trimesh", "dask", "pip install 'tron-relight[datagen]'"]),
        ("tron-reconstruct", [], ["pycolmap", "pip install 'tron-relight[reconstruct]'"]),
        ("tron-eval", [], ["matplotlib", "pip install 'tron-relight[eval]'"]),
        (
            "tron-relight",
            ["scene=ball.ply", "environment=white.hdr", "checkpoint=ball.ply", "output_dir=out"],
            ["checkpoint needs", "torch", "pip install 'tron-relight[network]'"],
        ),
    ],
)
def test_a_command_whose_extra_is_missing_says_so(smallest: Path, tmp_path: Path, command, arguments, words):
    make_ball().save(tmp_path / "ball.ply")
    EnvironmentMap.constant(1.0).save(tmp_path / "white.hdr")
    refused = start(smallest, command, *arguments, cwd=tmp_path)
    assert refused.returncode == 2, refused.stderr
    (line,) = [each for each in refused.stderr.splitlines() if each.startswith(f"{command}: ")]
    assert [word for word in words if word not in line] == []
    assert "Traceback" not in refused.stderr


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_lists_every_key_without_the_extra_and_names_it(smallest: Path, tmp_path: Path, command: str):
    shown = start(smallest, command, "--help", "all", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    installed = command in (
        "tron-relight",
        "tron-edit",
        "tron-bake",
        "tron-environment",
        "tron-export",
    )  # whose libraries this environment has
    extra = f"tron-relight[{'relight' if installed else command.removeprefix('tron-')}]"
    first = f"part of {extra}, which is installed" if installed else f"needs pip install '{extra}'"
    assert shown.stdout.startswith(first)
    assert "\n  output" in shown.stdout


def test_a_scene_is_edited_without_torch(smallest: Path, tmp_path: Path):
    make_ball().save(tmp_path / "ball.ply")
    insert = "- {action: insert, file: ball.ply, at: [0, 0, 3], object: 5}\n"
    (tmp_path / "edits.yaml").write_text(insert + "- {action: remove, select: {object: 5}}\n")
    asked = ("scene=ball.ply", "edits=edits.yaml", "output=edited.ply")
    done = start(smallest, "tron-edit", *asked, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "edited.ply").read_bytes() == (tmp_path / "ball.ply").read_bytes()


def make_ball() -> GaussianScene:
    """A red sphere of surfels."""
    angle, z = np.pi * (3 - 5**0.5) * np.arange(400), 1 - (2 * np.arange(400) + 1) / 400
    level = np.sqrt(1 - z**2)
    normals = np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)
    color = np.tile([0.8, 0.1, 0.1], (400, 1))
    return GaussianScene(
        means=normals,
        quats=quats_from_normals(normals),
        log_scales=np.full((400, 2), np.log(0.1)),
        opacity_logits=np.full(400, 4.0),
        sh=np.zeros((400, 16, 3)),
        base_color=color,
        roughness=np.full(400, 0.8),
        metallic=np.zeros(400),
        object_id=np.zeros(400, np.int32),
        spacing=0.17,
    ).validate()


def start(environment: Path, command: str, *arguments: str, cwd: Path, **variables: str):
    """A console script as a user starts it: of this shell's PYTHON... variables it has none."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    return subprocess.run(
        [environment / "bin" / command, *arguments],
        cwd=cwd,
        env={**inherited, **variables},
        capture_output=True,
        text=True,
    )


def _run(*command: str | Path) -> None:
    done = subprocess.run([str(each) for each in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr

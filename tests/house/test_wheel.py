"""The wheel carries our five packages and nothing else; its commands import ours, whatever lies around."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tron", "conf", "datagen", "train", "eval")
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy: setuptools leaves build/ and *.egg-info beside the sources."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    (source / "outputs").mkdir()
    (source / "outputs" / "__init__.py").touch()  # a package beside ours that must stay outside
    target = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", target, source)
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment with the wheel alone in it: its folder."""
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    _run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    return folder


def test_the_wheel_holds_every_module_and_data_file_and_nothing_else(wheel: Path):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = {path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()}
    expected = {str(path.relative_to(ROOT)) for path in files if "__pycache__" not in path.parts}
    assert names == expected


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_a_command_imports_ours_beside_decoys(installed: Path, tmp_path: Path, command: str):
    for name in PACKAGES:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a decoy was imported')\n")
    # The dependencies come from this environment, behind the clean one's own packages; PYTHONSAFEPATH and
    # the like are dropped: the user's shell has none of them.
    (dependencies,) = {sysconfig.get_path("purelib")}
    own = installed / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    (own / "dependencies.pth").write_text(f"import sys; sys.path.append({dependencies!r})\n")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    shown = subprocess.run(
        [installed / "bin" / command, "--help"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert shown.returncode == 0, shown.stderr
    assert f"usage: {command}" in shown.stdout
    module = COMMANDS[command].partition(":")[0]
    where = _run(
        installed / "bin" / "python", "-P", "-c", f"import {module} as m; print(m.__file__)", cwd=tmp_path
    )
    assert Path(where.strip()).is_relative_to(installed)


def _run(*command: str | Path, cwd: Path | None = None) -> str:
    done = subprocess.run([str(each) for each in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout

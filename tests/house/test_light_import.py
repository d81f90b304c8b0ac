"""A script that asks for a version, and help, wait for neither torch nor Mitsuba."""

import os
import subprocess
import sys
from importlib import import_module

import pytest

from tron.apps.splat_file import SPLATS
from tron.captures.load import FORMATS
from tron.cli import installation
from tron.cli.recipes import field_keys
from tron.gaussians.formats.registry import WRITTEN

HEAVY = {"mitsuba", "drjit", "torch", "lightning", "diffusers", "torchmetrics", "hydra"}
GROUND = "errors seeds storage io.images color cameras trajectories metrics runtime io.video"


def test_imports_load_neither_renderer_nor_torch():
    """`import tron` alone not even NumPy; OpenCV and pycolmap wait for a capture that needs them."""
    ground = "; ".join(f"import tron.{name}" for name in GROUND.split())
    code = f"import sys, tron; print(*sys.modules); {ground}; print(*sys.modules)"
    code += "; import tron.captures; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    alone, ground, captures = map(set, map(str.split, done.stdout.splitlines()))
    assert "tron.captures" in captures
    assert not (HEAVY | {"numpy"}) & alone
    assert not HEAVY & ground
    assert not (HEAVY | {"cv2", "pycolmap"}) & captures


COMMANDS = [
    "relight",
    "edit",
    "bake",
    "environment",
    "export",
    "view",
    "reconstruct",
    "datagen",
    "train",
    "evaluate",
]
UNASKED = ("mitsuba", "drjit", "torch", "scipy", "pycolmap", "lightning")
PROGRAM = """
import sys
from tron.cli import installation
try: getattr(installation, sys.argv[1])(sys.argv[2:])
except SystemExit as end: print(end.code, *sys.modules)
"""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_short_and_it_and_a_mistyped_key_wait_for_no_library(command: str):
    for words, code in ((["--help"], "0"), (["outptu_dri=there"], "2")):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, command, *words],
            capture_output=True, text=True, check=True, env=os.environ | {"COLUMNS": "200"},
        )  # fmt: skip
        *page, end = done.stdout.splitlines()
        assert end.split()[0] == code, done.stderr
        loaded = {each.partition(".")[0] for each in end.split()}
        assert [each for each in UNASKED if each in loaded] == []
        assert len(page) <= 60
        assert [line for line in page if len(line) > 110] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_at_most_ten_settings_that_there_are(command: str):
    known = getattr(installation, command).load()
    assert 5 < len(known.shown) <= 10
    assert set(known.shown) <= set(field_keys(known.settings))


def test_the_suffixes_that_help_names_are_those_that_are_written():
    assert SPLATS == WRITTEN


@pytest.mark.parametrize("package", ["captures", "editing", "reconstruction", "scans", "shards"])
def test_names_that_a_package_imports_later_are_there(package: str):
    module = import_module(f"tron.{package}")
    assert [name for name in module.__all__ if not hasattr(module, name)] == []


def test_readers_that_the_capture_formats_import_later_are_there():
    for each in FORMATS.values():
        for reader in (each.detect, each.read):
            module, name = getattr(reader, "args", (None, ""))[:2]
            assert module is None or callable(getattr(import_module(module), name)), reader


def test_a_scan_is_lit_and_its_materials_are_found_without_torch():
    """Nor by what reads datasets, poses photos or draws plots: a frame waits for no import that it leaves."""
    used = "tron.apps.relight.command tron.relighting tron.reconstruction.materials.carried"
    code = f"import sys; {'; '.join(f'import {name}' for name in used.split())}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "tron.reconstruction.light.fit_pairs" in loaded
    away = {"torch", "lightning", "diffusers", "torchmetrics", "safetensors", "fsspec", "webdataset"}
    assert not (away | {"pycolmap", "matplotlib", "pandas", "trimesh", "jinja2", "dask"}) & loaded

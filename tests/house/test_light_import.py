"""A script that asks for a version, and help, wait for neither torch nor Mitsuba."""

import subprocess
import sys

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


def test_help_of_training_waits_for_no_torch():
    program = (
        "import sys; from train.cli import cli\n"
        "try: cli(['--help'])\n"
        "except SystemExit: print('loaded', {'torch', 'diffusers', 'lightning'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded set()"


def test_a_scan_is_lit_and_its_materials_are_found_without_torch():
    """Nor by what reads datasets, poses photos or draws plots: a frame waits for no import that it leaves."""
    used = "tron.apps.relight.command tron.relighting tron.reconstruction.materials.carried"
    code = f"import sys; {'; '.join(f'import {name}' for name in used.split())}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "tron.reconstruction.light.fit_pairs" in loaded
    away = {"torch", "lightning", "diffusers", "torchmetrics", "safetensors", "fsspec", "webdataset"}
    assert not (away | {"pycolmap", "matplotlib", "pandas", "trimesh", "jinja2", "dask"}) & loaded

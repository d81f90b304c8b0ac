"""`import tron` is light: a script that only asks for the version must not wait for torch or Mitsuba."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_importing_tron_loads_neither_renderer_nor_torch():
    heavy = ("mitsuba", "drjit", "torch", "lightning", "diffusers", "hydra", "numpy")
    code = f"import sys, tron; print([name for name in {heavy!r} if name in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_help_of_training_waits_for_no_torch():
    program = (
        "import sys; from train.cli import cli\n"
        "try: cli(['--help'])\n"
        "except SystemExit: print('loaded', {'torch', 'diffusers', 'lightning'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded set()"

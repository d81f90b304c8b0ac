"""Importing the loaders loads neither OpenCV nor pycolmap: those wait for a capture that needs them."""

import subprocess
import sys

HEAVY = {"mitsuba", "drjit", "torch", "cv2", "pycolmap"}


def test_importing_captures_is_light() -> None:
    code = "import sys, tron.captures; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "tron" in loaded.split()
    assert not HEAVY & set(loaded.split())

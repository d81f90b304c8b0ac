"""``import tron`` and the ground floor stay light."""

import subprocess
import sys

import pytest

HEAVY = {"mitsuba", "drjit", "torch", "lightning", "diffusers", "torchmetrics", "hydra"}
GROUND = "errors seeds storage images color cameras trajectories metrics runtime video"


@pytest.mark.parametrize("modules", ["", GROUND], ids=["package", "ground floor"])
def test_import_loads_neither_renderer_nor_torch(modules: str):
    imports = "".join(f"import tron.{name}\n" for name in modules.split())
    code = f"import sys, tron\n{imports}print(*{{name.split('.')[0] for name in sys.modules}})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "tron" in loaded.split()
    assert not HEAVY & set(loaded.split())

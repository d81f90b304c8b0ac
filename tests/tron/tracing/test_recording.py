"""What is recorded is not disturbed by what Python throws away meanwhile."""

import subprocess
import sys

CODE = """
import gc
from tron.runtime import activate
activate("llvm_ad_rgb")
import drjit as dr
import mitsuba as mi
from tron.tracing.kernel import recorded

class Cycle:
    def __init__(self):
        self.itself, self.scene = self, mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})

@recorded
def doubled(x):
    gc.set_threshold(1)
    [[] for _ in range(100)]  # with the collector on, any of these lists would set it off
    return 2 * x

gc.disable()
Cycle()
gc.enable()
found = doubled(mi.Float(1, 2))
gc.set_threshold(700)
assert gc.isenabled() and gc.collect() > 0
print(found)
"""


def test_a_scene_that_nobody_holds_does_not_end_a_recording():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[2, 4]"), done.stderr[-500:]

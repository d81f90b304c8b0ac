"""pycolmap, imported, leaves SIGTERM as it was: no native stack, and work in hand can end in order."""

import os
import signal
import subprocess
import sys

import pytest

PROGRAM = """
import os, signal, threading
from tron.lenses import load_pycolmap
{before}
thread = threading.Thread(target=load_pycolmap)  # as a worker of tron-datagen does
thread.start()
thread.join()
os.kill(os.getpid(), signal.SIGTERM)
"""


@pytest.mark.parametrize(
    ("before", "code"),
    [
        ("", -signal.SIGTERM),
        ("signal.signal(signal.SIGTERM, lambda *_: os._exit(7))", 7),
        ("signal.signal(signal.SIGTERM, signal.SIG_IGN)", 0),
    ],
    ids=["default", "handler", "ignored"],
)
def test_sigterm_means_what_it_meant_before(before: str, code: int):
    words = [sys.executable, "-c", PROGRAM.format(before=before)]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ, check=False)
    assert (done.returncode, done.stderr) == (code, "")

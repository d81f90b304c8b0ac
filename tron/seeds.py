"""The seed tree: every random number in TRON comes from a root seed and a path of names.

``generator(root, "scene", 12, "lights")`` is a stream of its own: it does not depend on what else was drawn,
on the order of the calls or on the process that makes them. Names are hashed with SHA-256, never with
Python's ``hash``, which changes from run to run; the stream itself is NumPy's PCG64, specified bit by bit.
"""

from __future__ import annotations

import hashlib

import numpy as np


def _sequence(root: int, path: tuple[str | int, ...]) -> np.random.SeedSequence:
    digest = hashlib.sha256()
    for part in (root, *path):
        # A type tag and a length keep ("1",) apart from (1,), and ("ab", "c") from ("a", "bc").
        tag = b"i" if isinstance(part, (int, np.integer)) else b"s"
        text = str(int(part) if tag == b"i" else part).encode()
        digest.update(tag + len(text).to_bytes(8, "little") + text)
    return np.random.SeedSequence(np.frombuffer(digest.digest(), dtype="<u4").tolist())


def generator(root: int, *path: str | int) -> np.random.Generator:
    """Return the random stream at ``path`` below ``root``.

    Args:
        root: the run's seed, any integer; 0 is a seed like any other.
        path: names and numbers from the general to the particular, e.g. ``"scene", 12, "lights"``.
    """
    return np.random.Generator(np.random.PCG64(_sequence(root, path)))


def integer(root: int, *path: str | int, bits: int = 32) -> int:
    """Return an integer in [0, 2**bits) for libraries that want a seed of their own (Mitsuba, torch).

    Args:
        root: the run's seed.
        path: as in :func:`generator`.
        bits: 1 to 64; 32 suits Mitsuba's samplers, 63 suits ``torch.manual_seed``.
    """
    if not 1 <= bits <= 64:
        raise ValueError(f"bits must be in 1..64, not {bits}")
    return int(_sequence(root, path).generate_state(1, np.uint64)[0]) >> (64 - bits)

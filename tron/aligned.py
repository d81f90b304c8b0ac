"""NumPy arrays in memory that every kernel reads in the same way.

Dr.Jit borrows the memory of a NumPy array and writes its alignment into the kernels that read it: loads of
whole packets where it begins at a multiple of 64 bytes, else loads byte by byte, and gathers of four numbers
one by one. NumPy's memory begins at any multiple of 16, by chance, so the same call would now and then
compile another and slower kernel.
"""

from __future__ import annotations

import numpy as np

ALIGNMENT = 64
"""Bytes of the widest packet: 16 numbers of 32 bits."""


def aligned(array: np.ndarray) -> np.ndarray:
    """The array, contiguous, at a multiple of ``ALIGNMENT`` bytes; itself where it is that already."""
    array = np.ascontiguousarray(array)
    if array.ctypes.data % ALIGNMENT == 0:
        return array
    memory = np.empty(array.nbytes + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    copy = memory[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy

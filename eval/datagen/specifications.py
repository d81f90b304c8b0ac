"""Specifications of the same scenes, drawn by other numbers of workers and threads and on another processor.

The other processor is stood in for by switches of three libraries, which change last bits as other machines
do: NumPy without its vector instructions beyond the baseline (float32 sines, exponentials, powers),
OpenBLAS with the kernels of a Nehalem (products of matrices, inverses), and the C library without AVX2 and
FMA (float64 sines and arctangents, random gamma variates).
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.datagen.runs import differences, make
from eval.results import Row
from tron.report.page import Cell, Section, Table

SPECIFICATION = "spec.json"
USUAL = "one worker"


@dataclass(frozen=True)
class Way:
    """A way to draw the same scenes: further arguments of tron-datagen, and additions to its environment."""

    arguments: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Specifications:
    """Way -> specifications that differ from those of USUAL."""

    different: Mapping[str, list[str]]
    scenes: int

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Share of the specifications that are the same bytes."""
        total = len(self.different) * self.scenes
        same = total - sum(map(len, self.different.values()))
        yield Row(metric="specifications.identical", value=same / total, unit="fraction", n=total)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every way in a table."""
        rows = [
            [way, Cell("same bytes", "good") if not names else Cell(f"{', '.join(names[:3])} differ", "bad")]
            for way, names in self.different.items()
        ]
        caption = f"Specifications of {self.scenes} scenes, held against those drawn by {USUAL}."
        return [Section("specifications", "Specifications", [Table(caption, ["Drawn by", ""], rows)])]


def ways() -> dict[str, Way]:
    """Ways beside USUAL."""
    threads = (("OMP_NUM_THREADS", "3"), ("OPENBLAS_NUM_THREADS", "3"), ("MKL_NUM_THREADS", "3"))
    found = {
        "two workers": Way(("workers=2",)),
        "this process, three threads": Way(("cluster=none",), threads),
    }
    extensions = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])  # type: ignore[index]
    if extensions:
        fewer = (("NPY_DISABLE_CPU_FEATURES", " ".join(extensions)),)
        found["NumPy's baseline of vector instructions"] = Way(("workers=1",), fewer)
    found["OpenBLAS for a Nehalem"] = Way(("workers=1",), (("OPENBLAS_CORETYPE", "Nehalem"),))
    without = ",".join(f"-{name}" for name in ("AVX2", "FMA", "AVX512F", "AVX2_Usable", "FMA_Usable"))
    tunables = (("GLIBC_TUNABLES", f"glibc.cpu.hwcaps={without}"),)
    found["the C library without AVX2 and FMA"] = Way(("workers=1",), tunables)
    return found


def measure_specifications(recipe: Sequence[str], folder: Path) -> Specifications:
    """Make the scenes of a recipe in every way, and compare their specifications.

    Raises:
        StageFailed: a run failed.
    """
    output = folder / "specifications"
    drawn: dict[str, dict[str, bytes]] = {}
    for name, way in {USUAL: Way(("workers=1",)), **ways()}.items():
        shutil.rmtree(output, ignore_errors=True)
        make([*recipe, *way.arguments], output, dict(way.environment))
        paths = output.glob(f"scenes/*/{SPECIFICATION}")
        drawn[name] = {path.parent.name: path.read_bytes() for path in paths}
    shutil.rmtree(output)
    usual = drawn.pop(USUAL)
    return Specifications({name: differences(usual, each) for name, each in drawn.items()}, len(usual))

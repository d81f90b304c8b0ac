"""Benchmark `tron_synth`: the suite of that name made, TRON's ways and a mesh shown on it, and all judged.

What the single commands do (`tron-eval export=`, `method=`, `benchmark=compare`), in one. Two questions have
rows of their own: what the network gains over the best of the ways without one, on surfels through the true
surfaces; and what TRON gains from photos alone over the mesh that an engineer would fit to them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from eval.benchmark import Benchmark
from eval.compare.benchmark import Compare
from eval.protocol.method import METHOD_NAME
from eval.protocol.suite import SUITE_NAME
from eval.report.outcome import Outcome
from eval.results import Row
from eval.stages import Child, Stages, script_path
from tron.cli.installation import require_own_packages
from tron.denoising import require

Part = Literal["true_maps", "photos", "mesh_peer"]
NETWORK, WITHOUT = "maps_network", "maps_"
"""The network on surfels through true surfaces, and what the names of all ways on those begin with."""
OURS, PEER = "photos_network", "mesh_peer"
"""Of TRON's ways from photos the one that is held against the mesh; the mesh."""


class Synthetic(Benchmark):
    """Settings: the suite, the methods on it, and arguments of each command."""

    name: ClassVar[str] = "tron_synth"

    export: list[str] = Field(description="arguments of tron-eval that make the suite")
    methods: dict[Part, list[str]] = Field(description="method -> further arguments of tron-eval method=NAME")
    compare: Compare = Field(description="settings of the comparison; suite and methods are filled in")

    def check(self) -> None:
        """Find what the stages call."""
        require_own_packages("datagen", "tron.reconstruction")
        for script in ("tron-eval", "tron-datagen", "tron-reconstruct"):
            script_path(script)
        require("oidn", "benchmark=tron_synth")  # of the mesh, and a way

    def run(self, output_dir: Path) -> Outcome:
        """Run the stages that are not finished; judge anew.

        Raises:
            StageFailed: a command failed; what was finished before it is kept and is not redone.
        """
        folder, stages = output_dir.absolute(), Stages(output_dir.absolute())
        made, shown = folder / "suite", folder / "methods"
        stages.run("suite", [Child("suite", "tron-eval", [*self.export, f"output_dir={made}"])])
        suite = next(path.parent for path in sorted(made.glob(f"*/{SUITE_NAME}")))
        children = {
            method: Child(
                method,
                "tron-eval",
                [f"method={method}", f"suite={suite}", *given, f"output_dir={shown / method}"],
            )
            for method, given in self.methods.items()
        }
        if maps := children.pop("true_maps", None):
            stages.run("true_maps", [maps])
        if children:  # at the same time, so that neither has a quieter machine
            stages.run("from_photos", list(children.values()))
        folders = sorted(path.parent for path in shown.glob(f"*/*/{METHOD_NAME}"))
        judging = self.compare.model_copy(update={"suite": suite, "methods": folders})
        stages.restart("compare")
        with stages.timed("compare", [["tron-eval", "benchmark=compare", f"suite={suite}"]]):
            outcome = judging.run(output_dir)
        outcome.add(gains({row.metric: row for row in outcome.rows}))
        seconds = {name: record.seconds for name, record in stages.records.items()}
        outcome.rows += [
            Row(metric=f"synth.{name}_seconds", value=value, unit="s", n=1) for name, value in seconds.items()
        ]
        outcome.rows.append(Row(metric="synth.minutes", value=sum(seconds.values()) / 60, unit="min", n=1))
        return outcome


def gains(rows: Mapping[str, Row]) -> Iterator[Row]:
    """The two questions' rows, from those of the comparison; none where a method is not there."""
    ours = [name.removesuffix(".faults") for name in rows if name.endswith(".faults")]
    others = [name for name in ours if name.startswith(WITHOUT) and name != NETWORK]
    # A method with a fault has no mean, and no best is sought among those that happen to have one.
    if others and all(f"{name}.psnr" in rows for name in (NETWORK, *others)):
        best = max(others, key=lambda name: rows[f"{name}.psnr"].value)
        yield _gain(rows, NETWORK, best, "synth.network_gain_db")
    if f"{OURS}.psnr" in rows and f"{PEER}.psnr" in rows:
        yield _gain(rows, OURS, PEER, "synth.gain_over_mesh_db")
    fit, peer = rows.get(f"{OURS}.seconds_fit"), rows.get(f"{PEER}.seconds_fit")
    if fit and peer:
        yield Row(metric="synth.time_over_mesh", value=fit.value / peer.value, unit="x", n=fit.n)


def _gain(rows: Mapping[str, Row], ours: str, other: str, metric: str) -> Row:
    """Of the comparison, which names the better of two first."""
    row, turned = rows.get(f"{ours}.gain_over_{other}"), False
    if row is None:
        row, turned = rows[f"{other}.gain_over_{ours}"], True
    told = {"metric": metric, "reference": other}
    if turned:
        low, high = (None if end is None else -end for end in (row.high, row.low))
        without = row.without_one and (-row.without_one[1], -row.without_one[0])
        told |= {"value": -row.value, "low": low, "high": high, "without_one": without}
    return row.model_copy(update=told)

"""Benchmark `tron_synth`: make the suite TRON-Synth, render it by TRON's ways and a mesh, judge all.

It runs the commands `tron-eval export=`, `method=` and `benchmark=compare`. Two gains have rows of their own:
the network over the best way without one, on surfels of the true surfaces; and TRON from photos alone over
the mesh that an engineer would fit to the photos.
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

    export: list[str] = Field(description="arguments of tron-eval that export the suite")
    methods: dict[Part, list[str]] = Field(description="method -> further arguments of tron-eval method=NAME")
    compare: Compare = Field(description="settings of benchmark=compare; suite and methods are filled in")

    def check(self) -> None:
        """Find the commands of the stages."""
        require_own_packages("datagen", "tron.reconstruction")
        for script in ("tron-eval", "tron-datagen", "tron-reconstruct"):
            script_path(script)
        require("oidn", "benchmark=tron_synth")  # of the mesh, and a way

    def run(self, output_dir: Path) -> Outcome:
        """Run the unfinished stages, then judge again.

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
    """Yield rows of the two gains from rows of the comparison; no row if a method is absent."""
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
    """Return a gain from the comparison, whose rows name the better of two methods first."""
    row, turned = rows.get(f"{ours}.gain_over_{other}"), False
    if row is None:
        row, turned = rows[f"{other}.gain_over_{ours}"], True
    told = {"metric": metric, "reference": other}
    if turned:
        low, high = (None if end is None else -end for end in (row.high, row.low))
        without = row.without_one and (-row.without_one[1], -row.without_one[0])
        told |= {"value": -row.value, "low": low, "high": high, "without_one": without}
    return row.model_copy(update=told)

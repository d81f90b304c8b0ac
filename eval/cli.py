"""`tron-eval`: run one benchmark, write results.json and report.html, and print the figures."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from tron.cli.command_line import command
from tron.cli.instantiation import make
from tron.errors import TronError
from tron.shards.dataset_folder import DatasetPlace
from tron.storage import locked

if TYPE_CHECKING:
    from eval.benchmark import Benchmark


class Settings(BaseModel):
    """Settings of `tron-eval`; settings of one benchmark are under `benchmark`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    benchmark: dict[str, Any] = Field(description="settings of the benchmark; benchmark=NAME chooses it")
    export: dict[str, Any] | None = Field(
        default=None,
        description="settings of a suite of scenes; export=NAME writes it to output_dir/NAME, for "
        "methods that benchmark=compare judges, and measures nothing",
    )
    method: dict[str, Any] | None = Field(
        default=None,
        description="settings of a method that runs here; method=NAME writes its pictures of suite to "
        "output_dir/METHOD, for benchmark=compare",
    )
    output_dir: Path = Field(
        default=Path("outputs/eval"), description="folder for results.json, report.html and the pictures"
    )
    report: Path | None = Field(
        default=None,
        description="folder with results.json: write its report.html anew, and measure nothing",
    )
    dataset: DatasetPlace | None = Field(
        default=None, description="data set to evaluate on, made by tron-datagen: its folder or URL"
    )
    renderer: Path | list[Path] | None = Field(
        default=None,
        description="weights of the neural renderer (.safetensors); [a,b]: one with lit, one of two buffers",
    )
    pixel_mlp: Path | list[Path] | None = Field(
        default=None, description="weights of the pixel MLP baseline; [a,b] as for renderer"
    )
    suite: Path | None = Field(
        default=None,
        description="suite of scenes for methods and their comparison; export=NAME writes one",
    )
    methods: Path | list[Path] | None = Field(
        default=None,
        description="folder with a folder of pictures for each method, or a list of such folders, [a,b]",
    )
    threads: PositiveInt = Field(default=1, description="CPU threads of the networks")
    seed: int = Field(default=0, description="seed of every random choice")


def main(settings: Settings) -> int:
    """Measure TRON against baselines and targets; write results.json and a self-contained report.html.

    Exits with 0 whether or not the targets are reached: the report says so, and by how much.
    """
    from eval.page import write_page
    from eval.report.figures import print_results
    from eval.results import Results
    from eval.stages import StageFailed
    from tron.runtime import describe_machine

    if settings.report is not None:
        print(f"report: {write_page(settings.report).absolute()}", flush=True)
        return 0
    if settings.export is not None or settings.method is not None:
        with locked(settings.output_dir):
            try:
                print(_export(settings) if settings.export is not None else _method(settings), flush=True)
            except StageFailed as failure:
                print(f"tron-eval: {failure}", file=sys.stderr)
                return failure.exit_code
        return 0
    benchmark = make(settings.benchmark, "benchmark")
    for name in ("dataset", "renderer", "pixel_mlp", "suite", "methods"):
        if getattr(settings, name) is not None and name not in type(benchmark).model_fields:
            mend = f"leave it out; tron-eval benchmark={benchmark.name} --help all lists what it takes"
            raise TronError(f"benchmark={benchmark.name} takes no {name}", mend=mend)
    benchmark.check()
    with locked(settings.output_dir):
        try:
            outcome = benchmark.run(settings.output_dir)
        except StageFailed as failure:
            print(f"tron-eval: {failure}", file=sys.stderr)
            return failure.exit_code
        results = Results(
            benchmark=benchmark.name,
            environment={
                **describe_machine(),
                "inputs": {"settings": settings_of(benchmark), **outcome.inputs},
            },
            rows=outcome.rows,
            absent=outcome.absent,
            reproduce=outcome.reproduce or typed(),
            series=outcome.series,
            pictures=outcome.pictures,
        ).held_to(benchmark.bounds())
        results.save(settings.output_dir / "results.json")
        print_results(results, write_page(settings.output_dir))
    return 0


def _export(settings: Settings) -> str:
    """Write a suite and log its id, which methods cite."""
    suite = make(settings.export or {}, "export").write(settings.output_dir)
    lights = sum(len(scene.lights) for scene in suite.scenes.values())
    return f"suite {suite.id}: {len(suite.scenes)} scenes, {lights} lights, in {suite.folder.absolute()}"


def _method(settings: Settings) -> str:
    """Run a method and write its folders."""
    folders = make(settings.method or {}, "method").make(settings.output_dir.absolute())
    return "\n".join(f"method: {folder}" for folder in folders)


def settings_of(benchmark: Benchmark) -> dict[str, Any]:
    """Return a benchmark's settings as JSON values, without targets, which results.json has beside them."""
    return benchmark.model_dump(mode="json", exclude={"targets"})


def typed() -> list[str]:
    """Return the running command as typed; none if Python called it."""
    name, *arguments = sys.argv
    return [shlex.join(["tron-eval", *arguments])] if Path(name).name == "tron-eval" else []


cli = command(
    "tron-eval",
    "conf.eval",
    Settings,
    main,
    shown=("output_dir", "dataset", "renderer", "suite", "methods", "report", "threads", "seed"),
    listed="benchmark",
    examples=(
        "tron-eval benchmark=demo output_dir=outputs/demo",
        "tron-eval report=docs/benchmarks/tracing",
        "tron-eval export=tron_synth_small output_dir=outputs/suites",
        "tron-eval method=photos suite=outputs/suites/tron_synth_small output_dir=outputs/methods",
        "tron-eval benchmark=compare suite=outputs/suites/tron_synth_small methods=outputs/methods "
        "output_dir=outputs/compare",
        "tron-eval benchmark=judge suite=outputs/suites/tron_synth_small methods=outputs/methods "
        "benchmark.ours=NAME benchmark.endpoint=https://HOST/v1 benchmark.model=NAME "
        "output_dir=outputs/judge",
        "tron-eval benchmark=video suite=outputs/suites/tron_synth_small methods=outputs/methods "
        "output_dir=outputs/video",
        "tron-eval benchmark=relighting dataset=outputs/data renderer=outputs/train/renderer.safetensors "
        "output_dir=outputs/relighting",
        "tron-eval benchmark=tracing output_dir=outputs/tracing",
        "tron-eval benchmark=reconstruction output_dir=outputs/reconstruction",
        "tron-eval benchmark=datagen output_dir=outputs/datagen",
        "tron-eval benchmark=renderer benchmark.parts=[synthetic,clips] output_dir=outputs/renderer",
    ),
)

if __name__ == "__main__":
    cli()

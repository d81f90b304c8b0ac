"""Settings of the benchmarks of speed: the device, the seed, and rounds of timing."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.peers.timing import Rounds

DEFAULT_VARIANT = "llvm_ad_rgb"


class SpeedBenchmark(Benchmark):
    """Settings that benchmarks of speed share."""

    variant: str = Field(default=DEFAULT_VARIANT, description="Mitsuba variant; cuda_ad_rgb on a GPU")
    seed: int = 0
    repetitions: PositiveInt = Field(default=5, description="rounds of interleaved timing")
    slow_repetitions: PositiveInt = Field(default=3, description="rounds for what takes over a second")

    @property
    def rounds(self) -> Rounds:
        """Both numbers of rounds."""
        return Rounds(self.repetitions, self.slow_repetitions)

    def override(self, key: str = "variant") -> list[str]:
        """Variant as an argument of a command, if it is not the default."""
        return [] if self.variant == DEFAULT_VARIANT else [f"{key}={self.variant}"]

    def command_line(self, output_dir: Path) -> str:
        """Command that measures it again."""
        overrides = [*self.override("benchmark.variant"), f"output_dir={output_dir}"]
        return " ".join([f"tron-eval benchmark={self.name}", *overrides])

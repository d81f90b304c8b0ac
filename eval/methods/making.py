"""Base of methods that run here: `tron-eval method=NAME suite=DIR output_dir=METHODS`.

``conf/eval/method/NAME.yaml`` names the class by ``_target_``. A method writes folders, and
benchmark=compare judges them by the same rules as all others.
"""

from __future__ import annotations

import abc
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from eval.protocol.suite import Suite
from tron.errors import TronError


class Making(BaseModel, abc.ABC):
    """A method, or several methods that share expensive steps."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    suite: Path | None = Field(description="folder written by tron-eval export=SUITE")
    seed: int = 0

    def read_suite(self) -> Suite:
        """Read the suite; TronError if there is none."""
        if self.suite is None:
            raise TronError("no suite", mend="give suite=DIR, written by tron-eval export=SUITE")
        return Suite.load(self.suite)

    @abc.abstractmethod
    def make(self, output_dir: Path) -> list[Path]:
        """Write the methods' folders below ``output_dir`` and return them; finished parts are kept.

        Raises:
            TronError: an input is missing or is not what it should be.
            StageFailed: a command that it runs failed.
        """

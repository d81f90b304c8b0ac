"""Console scripts, and what each stands on: our own packages, unshadowed, and the libraries of its extra.

`datagen`, `train`, `eval` and `conf` are common names. Where another file of one of them comes first on
Python's path, or an extra is not installed, a command says so in one line instead of failing at an import.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from packaging.requirements import Requirement

import tron
from tron.errors import TronError

DISTRIBUTION = "tron-relight"
PACKAGES = ("conf", "datagen", "train", "eval")


def require_own_packages(*modules: str) -> None:
    """Raise TronError where a foreign file or folder shadows a package beside `tron`.

    Args:
        modules: names of modules, of whose packages those of PACKAGES are looked at. Those that a command
            does not import may be hidden: a user's own train.py does not stop tron-relight.
    """
    home = Path(tron.__file__).resolve().parents[1]
    imported = {module.partition(".")[0] for module in modules}
    for name in (name for name in PACKAGES if name in imported):
        # Not imported: a foreign file may do anything.
        spec = importlib.util.find_spec(name)
        if spec is None:
            mend = f"install {DISTRIBUTION} again"
            raise TronError(f"package '{name}' is missing", home / name, mend)
        origin = spec.origin or next(iter(spec.submodule_search_locations or ()), "unknown")
        if Path(origin).resolve() != home / name / "__init__.py":
            found = Path(origin).parent if Path(origin).name == "__init__.py" else Path(origin)
            raise TronError(
                f"this file hides TRON's own package '{name}'",
                found,
                "rename it, or run from another folder with its folder taken off PYTHONPATH",
            )


def require_extra(what: str, extra: str) -> None:
    """Raise TronError unless the libraries of an extra, as the installed package lists them, are there.

    Args:
        what: command or setting that needs them, for the message.
        extra: of pyproject.toml, such as "train".
    """
    missing = [name for name in dict.fromkeys(_libraries(extra)) if not _is_installed(name)]
    if missing:
        raise TronError(f"{what} needs {', '.join(missing)}", mend=f"pip install '{DISTRIBUTION}[{extra}]'")


def _libraries(extra: str) -> Iterator[str]:
    """Names of the distributions that an extra adds to the base, those of the extras it includes too."""
    try:
        requirements = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:  # run from a checkout that was never installed
        return
    for each in map(Requirement, requirements):
        if each.marker and each.marker.evaluate({"extra": extra}) and not each.marker.evaluate({"extra": ""}):
            if each.name == DISTRIBUTION:
                for included in sorted(each.extras):
                    yield from _libraries(included)
            else:
                yield each.name


def _is_installed(distribution: str) -> bool:
    try:
        importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


@dataclass(frozen=True)
class ConsoleScript:
    """A command as its script starts it: checked first, imported then.

    Attributes:
        name: as typed. Its extra is named as it is: `tron-train` needs `train`.
        module: holds the command as `cli`.
    """

    name: str
    module: str

    def load(self) -> Any:
        """The command itself, a tron.cli.command_line.Command."""
        return importlib.import_module(self.module).cli

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run on `arguments`, those of the process where None; ends in `SystemExit`."""
        try:
            require_own_packages("conf", self.module)
            require_extra(self.name, self.name.removeprefix("tron-"))
        except TronError as error:
            print(f"{self.name}: {error}", file=sys.stderr)
            sys.exit(2)
        sys.exit(self.load()(arguments))


relight = ConsoleScript("tron-relight", "tron.apps.relight")
reconstruct = ConsoleScript("tron-reconstruct", "tron.apps.reconstruct")
datagen = ConsoleScript("tron-datagen", "datagen.cli")
train = ConsoleScript("tron-train", "train.cli")
evaluate = ConsoleScript("tron-eval", "eval.cli")

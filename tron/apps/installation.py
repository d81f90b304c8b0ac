"""Console scripts, and what each stands on: our own packages, unshadowed, and the libraries of its extra.

`datagen`, `train`, `eval` and `conf` are common names. Where another file of one of them comes first on
Python's path, or an extra is not installed, a command says so in one line instead of failing at an import.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from packaging.requirements import Requirement

import tron
from tron.errors import TronError

DISTRIBUTION = "tron-relight"
PACKAGES = ("conf", "datagen", "train", "eval")


def require_own_packages() -> None:
    """Raise TronError where a foreign file or folder shadows one of the packages beside `tron`."""
    home = Path(tron.__file__).resolve().parents[1]
    for name in PACKAGES:
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


def _console_script(name: str, module: str) -> Callable[[], None]:
    """Entry point of a command whose extra is named as it is: `tron-train` needs `train`."""

    def run() -> None:
        try:
            require_own_packages()
            require_extra(name, name.removeprefix("tron-"))
        except TronError as error:
            print(f"{name}: {error}", file=sys.stderr)
            sys.exit(2)
        importlib.import_module(module).cli()

    return run


relight = _console_script("tron-relight", "tron.apps.relight")
reconstruct = _console_script("tron-reconstruct", "tron.apps.reconstruct")
datagen = _console_script("tron-datagen", "datagen.cli")
train = _console_script("tron-train", "train.cli")
evaluate = _console_script("tron-eval", "eval.cli")

"""Console scripts, and what each stands on: our own packages, unshadowed, and the libraries of its extra.

`datagen`, `train`, `eval` and `conf` are common names. Where another file of one of them comes first on
Python's path, or an extra is not installed, a command says so in one line instead of failing at an import.
`--help` names the extra, and works without it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NoReturn

import tron
from tron.errors import TronError
from tron.termination import termination_noted

DISTRIBUTION = "tron-relight"
SLOW_SECONDS = 4.0
PACKAGES = ("conf", "datagen", "train", "eval")


@contextmanager
def loading(name: str) -> Iterator[None]:
    """Say so on a terminal where the block, which imports libraries, takes long: from a cold disk it does.

    Ctrl-C and SIGTERM wait for its end: extensions make other errors of what is raised while they load.
    """
    loaded = threading.Event()

    def say() -> None:
        while not loaded.wait(SLOW_SECONDS):
            print(f"{name}: loading libraries", file=sys.stderr)

    if sys.stderr.isatty():  # in a log a mistake stays one line
        threading.Thread(target=say, daemon=True).start()
    try:
        with termination_noted(f"{name}: stopping once its libraries are loaded"):
            yield
    finally:
        loaded.set()


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
    if (error := lacks_extra(what, extra)) is not None:
        raise error


def lacks_extra(what: str, extra: str) -> TronError | None:
    """The error of :func:`require_extra`, not raised; None where nothing is missing."""
    missing = missing_libraries(extra)
    if not missing:
        return None
    return TronError(f"{what} needs {', '.join(missing)}", mend=f"pip install '{DISTRIBUTION}[{extra}]'")


def missing_libraries(extra: str) -> list[str]:
    """Distributions of an extra that are not installed."""
    return [name for name in dict.fromkeys(_libraries(extra)) if not _is_installed(name)]


def _libraries(extra: str) -> Iterator[str]:
    """Names of the distributions that an extra adds to the base, those of the extras it includes too."""
    from packaging.requirements import Requirement

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
        name: as typed.
        module: holds the command as `cli`.
        named: what its recipes name by `_target_`, and registries of words, which the module does not import.
        of_extra: the extra that it needs; None: that of its name, `train` for `tron-train`.
    """

    name: str
    module: str
    named: tuple[str, ...] = ()
    of_extra: str | None = None

    def load(self) -> Any:
        """The command itself, a tron.cli.command_line.Command."""
        return importlib.import_module(self.module).cli

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run on `arguments`, those of the process where None; ends in `SystemExit`."""
        extra = self.of_extra or self.name.removeprefix("tron-")
        asked = sys.argv[1:] if arguments is None else arguments
        try:
            require_own_packages("conf", self.module)
            if any(each in ("-h", "--help") or each.startswith("--help=") for each in asked):
                absent = missing_libraries(extra)
                known = f"{DISTRIBUTION}[{extra}]"
                needs = f"needs pip install '{known}'; not installed here: {', '.join(absent)}"
                print(f"{needs if absent else f'part of {known}, which is installed'}\n", flush=True)
                for each in self.named if absent else ():
                    import_without(each)
                loaded = import_without(self.module).cli if absent else self.load()
            else:
                require_extra(self.name, extra)
                with loading(self.name):
                    loaded = self.load()
        except TronError as error:
            print(f"{self.name}: {error}", file=sys.stderr)
            sys.exit(2)
        except KeyboardInterrupt:
            print(f"{self.name}: interrupted", file=sys.stderr)
            sys.exit(130)
        try:
            sys.exit(loaded(arguments))
        finally:  # what is left is the interpreter's own end
            signal.signal(signal.SIGINT, signal.SIG_IGN)


relight = ConsoleScript("tron-relight", "tron.apps.relight.cli")
edit = ConsoleScript("tron-edit", "tron.apps.edit", of_extra="relight")
bake = ConsoleScript("tron-bake", "tron.apps.bake", of_extra="relight")
environment = ConsoleScript("tron-environment", "tron.apps.environment", of_extra="relight")
export = ConsoleScript("tron-export", "tron.apps.export", of_extra="relight")
view = ConsoleScript("tron-view", "tron.apps.view")
reconstruct = ConsoleScript("tron-reconstruct", "tron.apps.reconstruct.cli", ("tron.reconstruction.priors",))
datagen = ConsoleScript(
    "tron-datagen",
    "datagen.cli",
    ("tron.reconstruction.priors", "datagen.world.scene"),
)
train = ConsoleScript("tron-train", "train.cli")
evaluate = ConsoleScript("tron-eval", "eval.cli")


OWN = ("tron", "conf", "datagen", "train", "eval")


class _StandInType(type):
    """Whatever is asked of a stand-in is another one: attributes, items, operators."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return StandIn

    def __getitem__(cls, key: Any) -> Any:
        return cls

    def __iter__(cls) -> Iterator[Any]:
        return iter(())

    def __or__(cls, other: Any) -> Any:
        return cls

    __ror__ = __add__ = __radd__ = __sub__ = __mul__ = __rmul__ = __truediv__ = __neg__ = __or__


class StandIn(metaclass=_StandInType):
    """Class, function, decorator or value of a library that is not there."""

    def __new__(cls, *arguments: Any, **_: Any) -> Any:
        """A decorated function stays itself."""
        return arguments[0] if arguments and isinstance(arguments[0], FunctionType | type) else StandIn


class _StandInModule(ModuleType):
    __path__: Sequence[str] = ()
    __all__: Sequence[str] = ()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return StandIn


class _Finder(Loader):
    """Finds every module of the packages that are named."""

    def __init__(self) -> None:
        self.packages: set[str] = set()

    def find_spec(self, name: str, _path: Any = None, _target: Any = None) -> ModuleSpec | None:
        """The spec of a stand-in."""
        return ModuleSpec(name, self, is_package=True) if name.partition(".")[0] in self.packages else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """A stand-in."""
        return _StandInModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is to be run."""


def import_without(name: str) -> ModuleType:
    """Import a module of ours; each library that is found missing on the way gets a stand-in, for good.

    Raises:
        ModuleNotFoundError: a module of our own is missing.
    """
    finder = _Finder()
    sys.meta_path.append(finder)  # type: ignore[arg-type]
    while True:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing in (*OWN, "", *finder.packages):
                raise
            finder.packages.add(missing)

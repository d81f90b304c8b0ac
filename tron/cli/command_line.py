"""One way into every command: compose, check, then run; a mistake of the user is one line and exit code 2.

    cli = command("tron-relight", "conf.relight", Settings, main)

Exit codes: 0 done; 1 a defect (with its traceback), or what `main` returns; 2 a mistake that the user can
mend, said in one line on stderr before long work starts; 130 interrupted.
"""

import argparse
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

import pydantic
import yaml
from omegaconf import OmegaConf

import tron
from tron.cli.help_page import default_examples, render_help
from tron.cli.installation import require_own_packages
from tron.cli.log import LEVELS, configure_logging
from tron.cli.profiling import profiled
from tron.cli.recipes import check, complete, compose_recipe, group_options, resolve
from tron.errors import TronError

Settings = TypeVar("Settings", bound=pydantic.BaseModel)

USER_ERROR = 2
INTERRUPTED = 130
TRACEBACK_VARIABLE = "TRON_TRACEBACK"
"""Environment variable that stands for --traceback in the commands that a command starts."""


@dataclass(frozen=True)
class Command(Generic[Settings]):
    """A console entry point: call it without arguments to read `sys.argv`; it ends in `SystemExit`."""

    name: str
    config_module: str
    settings: type[Settings]
    main: Callable[[Settings], int | None]
    examples: Sequence[str] = ()

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run on `arguments`, those of the process where None."""
        arguments = sys.argv[1:] if arguments is None else arguments
        with _tracebacks("--traceback" in arguments):
            sys.exit(self._run(arguments))

    def compose(self, *overrides: str) -> Settings:
        """Checked settings from `key=value` overrides, for `main` called from Python; TronError if wrong."""
        return check(compose_recipe(self.config_module, self.settings, overrides), self.settings)

    def _run(self, arguments: Sequence[str]) -> int:
        try:
            require_own_packages(self.config_module, self.settings.__module__)
            options = _parser(self.name).parse_intermixed_args(arguments)
            if options.help:
                print(self._help(options.overrides, options.config_dir), end="")
                return 0
            if options.version:
                print(f"{self.name} {tron.__version__}")
                return 0
            recipe = compose_recipe(self.config_module, self.settings, options.overrides, options.config_dir)
            if options.cfg:
                print(yaml.safe_dump(resolve(complete(recipe)), sort_keys=False), end="")
                return 0
            settings = check(recipe, self.settings)
            configure_logging(options.log_level)
            if options.profile:
                folder = getattr(settings, "output_dir", Path()) / "profile"
                with profiled(folder, self.name):
                    return self.main(settings) or 0
            return self.main(settings) or 0
        except TronError as error:
            if TRACEBACK_VARIABLE in os.environ:
                traceback.print_exc()
            print(f"{self.name}: {error}", file=sys.stderr)
            return USER_ERROR
        except KeyboardInterrupt:
            print(f"{self.name}: interrupted; the same command goes on from here", file=sys.stderr)
            return INTERRUPTED

    def _help(self, overrides: Sequence[str], config_dir: Path | None) -> str:
        groups = group_options(self.config_module)
        recipe = complete(compose_recipe(self.config_module, self.settings, overrides, config_dir))
        defaults: Any = OmegaConf.to_container(recipe, resolve=False)
        purpose = inspect.getdoc(self.main) or self.settings.__doc__ or self.name
        examples = self.examples or default_examples(self.name, groups)
        return render_help(self.name, purpose, self.settings, defaults, groups, examples)


def command(
    name: str,
    config_module: str,
    settings: type[Settings],
    main: Callable[[Settings], int | None],
    examples: Sequence[str] = (),
) -> Command[Settings]:
    """Make a console entry point.

    Args:
        name: the command as typed, such as `tron-datagen`; every error line starts with it.
        config_module: importable package with `config.yaml` and groups beside it, such as `conf.datagen`.
        settings: pydantic model of the whole configuration, `extra="forbid"`; its descriptions make `--help`.
        main: does the work; its docstring is what `--help` says the command does. It may return an exit code.
        examples: command lines for `--help`.
    """
    return Command(name, config_module, settings, main, examples)


@contextmanager
def _tracebacks(wanted: bool) -> Iterator[None]:
    """Show tracebacks of mistakes, here and in the commands that the block starts, where that is wanted."""
    own = wanted and TRACEBACK_VARIABLE not in os.environ
    if own:
        os.environ[TRACEBACK_VARIABLE] = "1"
    try:
        yield
    finally:
        if own:
            del os.environ[TRACEBACK_VARIABLE]


class _Arguments(argparse.ArgumentParser):
    """argparse, but a mistake is an exception: the caller prints it in its own one line."""

    def error(self, message: str) -> NoReturn:
        raise TronError(message, mend="--help shows how it is used")


def _parser(name: str) -> argparse.ArgumentParser:
    parser = _Arguments(prog=name, add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("--log-level", choices=LEVELS)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--traceback", action="store_true")
    parser.add_argument("--config-dir", type=Path)
    return parser

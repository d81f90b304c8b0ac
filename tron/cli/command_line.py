"""One way into every command: compose, check, then run; a mistake of the user is one line and exit code 2.

    cli = command("tron-relight", "conf.relight", Settings, main)

Exit codes: 0 done; 1 a defect (with its traceback), or what `main` returns; 2 a mistake that the user can
mend, said in one line on stderr before long work starts; 130 interrupted; 143 ended by SIGTERM.
"""

import argparse
import cProfile
import inspect
import json
import os
import pstats
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

import pydantic
import yaml
from omegaconf import OmegaConf

import tron
from tron import runtime
from tron.cli.help_page import HelpPage, default_examples
from tron.cli.installation import loading, require_own_packages
from tron.cli.log import LEVELS, configure_logging
from tron.cli.recipes import check, complete, compose_recipe, group_options, resolve
from tron.errors import TronError
from tron.storage import atomic_path, write_atomic
from tron.termination import TERMINATED, ending_behind, termination_unwinds

Settings = TypeVar("Settings", bound=pydantic.BaseModel)

USER_ERROR = 2
INTERRUPTED = 130
KEPT = "what is finished is kept, and the same command goes on from it"
"""What a command that was ended says, unless it is told otherwise or the exception has a note of its own."""
ANEW = "no file was written, and the same command begins anew"
"""The same where a command writes its files at once, at its end."""
TRACEBACK_VARIABLE = "TRON_TRACEBACK"
"""Environment variable that stands for --traceback in the commands that a command starts."""
SHOWN_FUNCTIONS = 15
KEPT_KERNELS = 20


@dataclass(frozen=True)
class Command(Generic[Settings]):
    """A console entry point: call it without arguments to read `sys.argv`; it ends in `SystemExit`."""

    name: str
    config_module: str
    settings: type[Settings]
    main: Callable[[Settings], int | None]
    examples: Sequence[str] = ()
    ended: str = KEPT
    shown: Sequence[str] = ()
    listed: str = ""

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run on `arguments`, those of the process where None."""
        arguments = sys.argv[1:] if arguments is None else arguments
        with _tracebacks("--traceback" in arguments), termination_unwinds():
            sys.exit(self._run(arguments))

    def compose(self, *overrides: str) -> Settings:
        """Checked settings from `key=value` overrides, for `main` called from Python; TronError if wrong."""
        return check(compose_recipe(self.config_module, self.settings, overrides), self.settings)

    def _run(self, arguments: Sequence[str]) -> int:
        kept = ""
        try:
            require_own_packages(self.config_module, self.settings.__module__)
            options = _parser(self.name).parse_intermixed_args(arguments)
            if "=" in (options.help or ""):  # --help key=value
                options.overrides.append(options.help)
                options.help = ""
            if options.help is not None:
                print(self._help(options.help, options.overrides, options.config_dir), end="")
                return 0
            if options.version:
                print(f"{self.name} {tron.__version__}")
                return 0
            recipe = compose_recipe(self.config_module, self.settings, options.overrides, options.config_dir)
            if options.cfg:
                print(yaml.safe_dump(resolve(complete(recipe)), sort_keys=False), end="")
                return 0
            with loading(self.name):
                settings = check(recipe, self.settings)
            kept = f"; {self.ended}" if self.ended else ""
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
        except BaseException as error:
            end = ending_behind(error)
            if end is None:
                raise
            verb, code = (
                ("terminated", TERMINATED) if isinstance(end, SystemExit) else ("interrupted", INTERRUPTED)
            )
            print(f"{self.name}: {verb}{_note(end) or kept}", file=sys.stderr)
            return code

    def _help(self, topic: str, overrides: Sequence[str], config_dir: Path | None) -> str:
        groups = group_options(self.config_module, config_dir)
        recipe = compose_recipe(self.config_module, self.settings, overrides, config_dir)
        if topic:  # the short page waits for no class that a recipe names
            recipe = complete(recipe)
        defaults: Any = OmegaConf.to_container(recipe, resolve=False)
        purpose = inspect.getdoc(self.main) or self.settings.__doc__ or self.name
        examples = self.examples or default_examples(self.name, groups)
        page = HelpPage(
            self.name, purpose, self.settings, defaults, groups, examples, self.shown, self.listed
        )
        return page.short() if not topic else page.whole() if topic == "all" else page.about(topic)


def command(
    name: str,
    config_module: str,
    settings: type[Settings],
    main: Callable[[Settings], int | None],
    examples: Sequence[str] = (),
    ended: str = KEPT,
    shown: Sequence[str] = (),
    listed: str = "",
) -> Command[Settings]:
    """Make a console entry point.

    Args:
        name: the command as typed, such as `tron-datagen`; every error line starts with it.
        config_module: importable package with `config.yaml` and groups beside it, such as `conf.datagen`.
        settings: pydantic model of the whole configuration, `extra="forbid"`; help tells its descriptions.
        main: does the work; its docstring is what `--help` says the command does. It may return an exit code.
        examples: command lines for `--help all`; the first three are those of `--help`.
        ended: what is left after an interruption, said behind it; "": nothing.
        shown: the keys that people set most, at most ten; `--help` shows these.
        listed: group of recipes whose options `--help` tells one by one.
    """
    return Command(name, config_module, settings, main, examples, ended, shown, listed)


def _note(end: BaseException) -> str:
    return "".join(f"; {note}" for note in getattr(end, "__notes__", ()))


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
    parser.add_argument("-h", "--help", nargs="?", const="")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--cfg", choices=["job"])
    parser.add_argument("--log-level", choices=LEVELS)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--traceback", action="store_true")
    parser.add_argument("--config-dir", type=Path)
    return parser


@contextmanager
def profiled(folder: Path, name: str) -> Iterator[None]:
    """Profile the block, whether it succeeds or not.

    Writes folder/NAME.prof (for snakeviz, pstats) and, where Dr.Jit was used, folder/NAME.kernels.json; shows
    the functions that took longest, and the sums of the kernels, on stderr. It sees the main thread of this
    process. Dr.Jit's history holds the code of every kernel that was started: long runs need memory for it.

    The block's own error always goes on. A run that was refused leaves no folder behind: after a TronError,
    the profile is written only where the folder above is there.

    Args:
        folder: made if missing.
        name: of the command, which the files are called after.

    Raises:
        TronError: the block succeeded, and its profile cannot be written.
    """
    profile = cProfile.Profile()
    runtime.keep_kernel_history = True
    profile.enable()
    try:
        yield
    except BaseException as error:
        kernels = _stop(profile)
        if not isinstance(error, TronError) or folder.parent.is_dir():
            try:
                _write(folder, name, profile, kernels)
            except TronError as second:
                print(f"profile: {second}", file=sys.stderr)
        raise
    _write(folder, name, profile, _stop(profile))


def _stop(profile: cProfile.Profile) -> dict[str, Any] | None:
    """End the profile and Dr.Jit's history; the summary of the latter, None where Dr.Jit was not used."""
    profile.disable()
    runtime.keep_kernel_history = False
    return _kernels()


def _write(folder: Path, name: str, profile: cProfile.Profile, kernels: dict[str, Any] | None) -> None:
    """Show a profile on stderr and write it; TronError where that cannot be."""
    pstats.Stats(profile, stream=sys.stderr).strip_dirs().sort_stats("tottime").print_stats(SHOWN_FUNCTIONS)
    if kernels is not None:
        said = (f"{key.replace('_', ' ')} {value}" for key, value in kernels.items() if key != "slowest")
        print(f"Dr.Jit: {', '.join(said)}", file=sys.stderr)
    path = folder / f"{name}.prof"
    with atomic_path(path) as temporary:
        profile.dump_stats(temporary)
    if kernels is not None:
        write_atomic(folder / f"{name}.kernels.json", json.dumps(kernels, indent=1) + "\n")
    print(f"profile: {path}", file=sys.stderr)


def summarize(history: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Sums over Dr.Jit's kernel history; its times are milliseconds, here they are seconds.

    A kernel is compiled once and started often; `compile_seconds` are code generation and the backend, and
    `slowest` are the kernels whose launches took longest together.
    """
    launches: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in history:
        launches[str(entry.get("hash", entry["type"]))].append(entry)
    kernels = [
        {
            "hash": key,
            "launches": len(entries),
            "operations": entries[0].get("operation_count"),
            "largest_size": max(entry["size"] for entry in entries),
            "execution_seconds": _seconds(entries, "execution_time"),
        }
        for key, entries in launches.items()
    ]
    kernels.sort(key=lambda kernel: kernel["execution_seconds"], reverse=True)
    return {
        "launches": len(history),
        "kernels": len({entry["hash"] for entry in history if "hash" in entry}),
        "cache_hits": sum(bool(entry.get("cache_hit")) for entry in history),
        "disk_cache_hits": sum(bool(entry.get("cache_disk")) for entry in history),
        "compile_seconds": round(_seconds(history, "codegen_time") + _seconds(history, "backend_time"), 3),
        "execution_seconds": _seconds(history, "execution_time"),
        "slowest": kernels[:KEPT_KERNELS],
    }


def _kernels() -> dict[str, Any] | None:
    """The summary of what Dr.Jit did in this process; None where it was never imported."""
    dr = sys.modules.get("drjit")
    if dr is None:
        return None
    history = dr.kernel_history()
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    return summarize(history)


def _seconds(entries: Sequence[dict[str, Any]], name: str) -> float:
    return round(sum(entry.get(name) or 0.0 for entry in entries) / 1000, 3)

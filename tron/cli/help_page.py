"""The page that `--help` prints: what a command does, every key with its default, recipes, and examples."""

import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import pydantic
import yaml
from pydantic.fields import FieldInfo

from tron.cli.recipes import nested_model
from tron.run_folder import leaves

OPTIONS = {
    "-h, --help": "print this page",
    "--cfg job": "print the resolved configuration as YAML and stop",
    "--config-dir DIR": "look for your own recipes in DIR first (DIR/experiment/NAME.yaml)",
    "--log-level LEVEL": "debug, info (default), warning or error",
    "--traceback": "show where in the code a mistake was found, not only its one line; in the commands "
    "that this one starts too",
    "--profile": "write the times of functions and Dr.Jit kernels to output_dir/profile; this process only: "
    "cluster=none shows tron-datagen's kernels",
    "--version": "print the version",
}
TYPE_NAMES = {
    Path: "path",
    str: "text",
    int: "integer",
    float: "number",
    bool: "true | false",
    type(None): "null",
}
NO_DEFAULT = object()  # of a field of a list's items: each item has its own value


def render_help(
    name: str,
    purpose: str,
    settings: type[pydantic.BaseModel],
    defaults: Mapping[str, Any],
    groups: Mapping[str, Mapping[str, str]],
    examples: Sequence[str],
) -> str:
    """The whole page as text, as wide as the terminal but at most 110 columns.

    Args:
        name: the command, such as `tron-relight`.
        purpose: what it does; reflowed.
        settings: the model whose fields are the keys.
        defaults: the composed configuration without overrides, nested; it wins over the model's defaults.
        groups: group -> option -> one line about it.
        examples: whole command lines.
    """
    width = min(shutil.get_terminal_size().columns, 110)
    page = [
        *_reflow(purpose, width),
        "",
        f"usage: {name} [key=value ...] [group=option ...]",
        "",
        "keys (default)",
    ]
    for key, field, default in _fields(settings, defaults):
        page += _entry(key, field, default, width)
    for group, options in groups.items():
        page += ["", f"{group}=NAME"]
        page += _table(options, width)
    page += ["", "options", *_table(OPTIONS, width), "", "examples"]
    page += [f"  {example}" for example in examples]
    return "\n".join(page) + "\n"


def default_examples(name: str, groups: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Command lines that hold for any command, for one that brings none of its own."""
    option = next(iter(groups.get("experiment", {})), None)
    recipe = f" experiment={option}" if option else ""
    return [f"{name}{recipe} output_dir=outputs/first", f"{name}{recipe} --cfg job"]


def describe_type(annotation: Any) -> str:
    """An annotation in a user's words: `Literal["a", "b"] | None` -> `a | b | null`."""
    origin = get_origin(annotation)
    if origin is Literal:
        return " | ".join(str(value) for value in get_args(annotation))
    if origin in (Union, types.UnionType):
        return " | ".join(describe_type(each) for each in get_args(annotation))
    if origin in (list, tuple, Sequence):
        inner = [describe_type(each) for each in get_args(annotation) if each is not Ellipsis]
        return f"list of {', '.join(dict.fromkeys(inner))}" if inner else "list"
    if hasattr(annotation, "__metadata__"):  # Annotated
        return describe_type(annotation.__origin__)
    return TYPE_NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _fields(
    model: type[pydantic.BaseModel], defaults: Any, prefix: str = ""
) -> Iterator[tuple[str, FieldInfo, Any]]:
    """Leaves of a settings model: dotted key, field, default."""
    for name, field in model.model_fields.items():
        if isinstance(defaults, Mapping) and name in defaults:
            default = defaults[name]
        else:
            default = "???" if field.is_required() else field.get_default(call_default_factory=True)
        inner = nested_model(field.annotation)
        if inner is not None:
            yield from _fields(inner, default, f"{prefix}{name}.")
            continue
        yield prefix + name, field, default
        for item in get_args(field.annotation):  # list[Model]: its fields, under N for the index
            if isinstance(item, type) and issubclass(item, pydantic.BaseModel):
                for key, part, _ in _fields(item, {}, f"{prefix}{name}.N."):
                    yield key, part, NO_DEFAULT


def _entry(key: str, field: FieldInfo, default: Any, width: int) -> list[str]:
    if isinstance(default, Mapping) and default:
        lines = [f"  {key}.*"]
    else:
        shown = "" if default is NO_DEFAULT else f"={_yaml(default)}"
        lines = [_shorten(f"  {key}{shown}   [{describe_type(field.annotation)}]", width)]
    indent = " " * 6
    lines += textwrap.wrap(field.description or "", width, initial_indent=indent, subsequent_indent=indent)
    inside = leaves(default) if isinstance(default, Mapping) else {}
    shown = [(name, value) for name, value in inside.items() if name.rpartition(".")[2] != "_target_"]
    return lines + [_shorten(f"    {key}.{name}={_yaml(value)}", width) for name, value in shown]


def _yaml(value: Any) -> str:
    if isinstance(value, pydantic.BaseModel):
        value = value.model_dump(mode="json")
    elif isinstance(value, Path):
        value = str(value)
    elif isinstance(value, tuple):
        value = list(value)
    if value == "???":
        return "VALUE (required)"
    return (
        yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
        .removesuffix("...\n")
        .strip()
    )


def _shorten(line: str, width: int) -> str:
    return line if len(line) <= width else line[: width - 3] + "..."


def _reflow(text: str, width: int) -> list[str]:
    paragraphs = textwrap.dedent(text).strip().split("\n\n")
    lines: list[str] = []
    for paragraph in paragraphs:
        lines += [*textwrap.wrap(paragraph, width), ""]
    return lines[:-1]


def _table(rows: Mapping[str, str], width: int) -> list[str]:
    gap = max((len(name) for name in rows), default=0) + 4
    lines: list[str] = []
    for name, text in rows.items():
        lines += textwrap.wrap(
            text, width, initial_indent=f"  {name}".ljust(gap), subsequent_indent=" " * gap
        ) or [f"  {name}"]
    return lines

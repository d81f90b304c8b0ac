"""What `--help` prints: a page to read, with `all` every key, recipe and option, with a NAME one of them."""

import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import pydantic
import yaml
from pydantic.fields import FieldInfo

from tron.cli.recipes import did_you_mean, nested_model
from tron.errors import TronError
from tron.lazily import OneOf
from tron.run_folder import leaves

OPTIONS = {
    "-h, --help": "print a short page; --help all: this page; --help NAME: one setting or group of recipes",
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


@dataclass(frozen=True)
class HelpPage:
    """All that is known of a command, as text as wide as the terminal but at most 110 columns.

    Attributes:
        name: the command, such as `tron-relight`.
        purpose: what it does; reflowed.
        settings: the model whose fields are the keys.
        defaults: the composed configuration without overrides, nested; it wins over the model's defaults.
        groups: group -> option -> one line about it.
        examples: whole command lines; the short page shows the first three.
        shown: keys of the short page.
        listed: group whose options the short page tells one by one.
    """

    name: str
    purpose: str
    settings: type[pydantic.BaseModel]
    defaults: Mapping[str, Any]
    groups: Mapping[str, Mapping[str, str]]
    examples: Sequence[str]
    shown: Sequence[str] = ()
    listed: str = ""

    @cached_property
    def width(self) -> int:
        """Columns of the text."""
        return min(shutil.get_terminal_size().columns, 110)

    def short(self) -> str:
        """What people read first: what the command does, what they set most, three examples."""
        page = [*_reflow(self.purpose.split("\n\n")[0], self.width), "", self._usage, ""]
        page.append("settings most used (default); --help all: the others; --help NAME: all about one")
        fields = {key: rest for key, *rest in _fields(self.settings, self.defaults)}
        for key in self.shown:
            field, default = fields[key]
            kind = describe_type(field.annotation, looked_up=False)
            page.append(_shorten(f"  {key}={_yaml(default)}   [{kind}]", self.width))
            page += _described(field, self.width, max_lines=2, placeholder=" ...")
        for group, options in self.groups.items():
            if group == self.listed:
                page += ["", f"{group}=NAME", *_table(options, self.width, max_lines=1, placeholder=" ...")]
            else:
                line = f"{group}=NAME   {', '.join(options)}"
                page += ["", *textwrap.wrap(line, self.width, subsequent_indent="    ")]
        return self._joined([*page, "", "examples", *(f"  {each}" for each in self.examples[:3])])

    def whole(self) -> str:
        """Everything."""
        page = [*_reflow(self.purpose, self.width), "", self._usage, "", "keys (default)"]
        for key, field, default in _fields(self.settings, self.defaults):
            page += _entry(key, field, default, self.width)
        for group, options in self.groups.items():
            page += ["", f"{group}=NAME", *_table(options, self.width)]
        page += ["", "options", *_table(OPTIONS, self.width)]
        return self._joined([*page, "", "examples", *(f"  {example}" for example in self.examples)])

    def about(self, name: str) -> str:
        """One setting, all that lie under a name, or a group of recipes.

        Raises:
            TronError: there is none of this name.
        """
        page, known = [], list(self.groups)
        for key, field, default in _fields(self.settings, self.defaults):
            inside = [f"{key}.{each}" for each in leaves(default)] if isinstance(default, Mapping) else []
            known += [key, *inside]
            if f"{key}.".startswith(f"{name}.") or name in inside:
                page += _entry(key, field, default, self.width)
        if name in self.groups:
            page += [f"{name}=NAME", *_table(self.groups[name], self.width)]
        if not page:
            mend = f"{did_you_mean(name, known)}--help all lists every setting"
            raise TronError(f"no setting '{name}'", mend=mend)
        return self._joined(page)

    @property
    def _usage(self) -> str:
        return f"usage: {self.name} [key=value ...] [group=option ...]"

    @staticmethod
    def _joined(lines: Sequence[str]) -> str:
        return "\n".join(lines) + "\n"


def default_examples(name: str, groups: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Command lines that hold for any command, for one that brings none of its own."""
    option = next(iter(groups.get("experiment", {})), None)
    recipe = f" experiment={option}" if option else ""
    return [f"{name}{recipe} output_dir=outputs/first", f"{name}{recipe} --cfg job"]


def describe_type(annotation: Any, looked_up: bool = True) -> str:
    """An annotation in a user's words: `Literal["a", "b"] | None` -> `a | b | null`.

    Args:
        annotation: of a field.
        looked_up: whether the words of a registry are imported and told.
    """
    origin = get_origin(annotation)
    if origin is Literal:
        return " | ".join(str(value) for value in get_args(annotation))
    if origin in (Union, types.UnionType):
        return " | ".join(describe_type(each, looked_up) for each in get_args(annotation))
    if origin in (list, tuple, Sequence):
        inner = [describe_type(each, looked_up) for each in get_args(annotation) if each is not Ellipsis]
        return f"list of {', '.join(dict.fromkeys(inner))}" if inner else "list"
    if hasattr(annotation, "__metadata__"):  # Annotated
        words = next((each for each in annotation.__metadata__ if isinstance(each, OneOf)), None)
        if words is not None and looked_up:
            return " | ".join(words.words())
        return describe_type(annotation.__origin__, looked_up)
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
    lines += _described(field, width)
    inside = leaves(default) if isinstance(default, Mapping) else {}
    shown = [(name, value) for name, value in inside.items() if name.rpartition(".")[2] != "_target_"]
    return lines + [_shorten(f"    {key}.{name}={_yaml(value)}", width) for name, value in shown]


def _described(field: FieldInfo, width: int, **at_most: Any) -> list[str]:
    text, indent = field.description or "", " " * 6
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent, **at_most)


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


def _table(rows: Mapping[str, str], width: int, **at_most: Any) -> list[str]:
    gap = max((len(name) for name in rows), default=0) + 4
    lines: list[str] = []
    for name, text in rows.items():
        lines += textwrap.wrap(
            text, width, initial_indent=f"  {name}".ljust(gap), subsequent_indent=" " * gap, **at_most
        ) or [f"  {name}"]
    return lines

"""From command-line overrides to checked settings: Hydra composes, pydantic checks, errors name the key.

A *recipe* is what Hydra composes from a command's folder of YAML files and the user's overrides. Everything
that can be wrong with it is found here, before any long work starts, and raised as a `TronError` of one line.
"""

import difflib
import inspect
import os
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import pydantic
import yaml
from hydra import compose, initialize_config_module
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic_core import to_jsonable_python

from tron.errors import TronError
from tron.run_folder import nested_items

Settings = TypeVar("Settings", bound=pydantic.BaseModel)

OWN_PACKAGES = ("tron", "datagen", "train", "eval")  # classes of others keep their defaults to themselves
SHARED_GROUP = "fidelity"  # beside the folders of the commands: a file has a part for each that it concerns
SHOWN_CHARACTERS = 80  # of a wrong value, so that the error stays one readable line


def compose_recipe(
    config_module: str,
    settings: type[pydantic.BaseModel],
    overrides: Sequence[str] = (),
    config_dir: Path | None = None,
) -> DictConfig:
    """Compose the model's defaults, `config.yaml` and its groups, and overrides in Hydra's grammar.

    Hydra's compose API is used instead of `hydra.main`: nothing is written and the working directory stays.
    YAML only says what differs from the model.

    Args:
        config_module: importable package that holds `config.yaml` and its groups.
        settings: model of the whole recipe.
        overrides: as typed on the command line; a later one wins.
        config_dir: the user's own folder of groups, searched beside the package's.

    Raises:
        TronError: an override cannot be parsed, or names a key, group or option that does not exist.
    """
    if config_dir is not None and not config_dir.is_dir():
        raise TronError("folder not found", where=config_dir, mend="--config-dir names a folder of recipes")
    search = [] if config_dir is None else [f'hydra.searchpath=["file://{config_dir.resolve()}"]']
    with _loader(config_module) as loader:
        groups = {name: _options(loader, name, config_dir) for name in _groups(loader)}
        shared = _shared_options(config_module)
        if shared:
            groups[SHARED_GROUP] = list(shared)
        chosen = [text for text in overrides if _key(text) in groups]
        selections = [_parse(text) for text in chosen]
        for index, each in enumerate(selections):
            if each.value() is None and not each.is_delete():
                selections[index] = _parse(f"{each.key_or_group}=none")  # null says the same of a single key
        for each in selections:
            _require_option(each, groups[each.key_or_group])
        try:
            own = [str(each.input_line) for each in selections if each.key_or_group != SHARED_GROUP]
            shipped = compose("config", overrides=[*search, *own])
            values = _merged(model_defaults(settings), OmegaConf.to_container(shipped))
            for each in selections:
                if each.key_or_group == SHARED_GROUP:
                    values = _merged(values, shared[str(each.value())][0])
            recipe = DictConfig(values)
            keys = [_setting(text, settings, values) for text in overrides if text not in chosen]
            changed = {each.key_or_group for each in keys if not each.is_add() and not each.is_force_add()}
            if any(_in_target(values, key) for key in changed - _keys(recipe)):
                recipe = complete(recipe)  # imports what it names
            for key in sorted(changed - _keys(recipe)):
                known = [*_keys(recipe), *groups]
                if not did_you_mean(key, known):  # a key of what is imported, without its parents
                    known += _keys(complete(recipe))
                raise unknown_key(key, known)
            for each in keys:
                _change(recipe, each)
            return recipe
        except (HydraException, OmegaConfBaseException) as error:
            raise TronError(_first_line(error), where=config_module) from error


def model_defaults(model: type[pydantic.BaseModel]) -> dict[str, Any]:
    """Defaults of a settings model as nested plain values, `???` where there is none."""
    values: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        inner = nested_model(field.annotation)
        if field.is_required():
            values[name] = "???" if inner is None else _seeded(model_defaults(inner))
        else:
            values[name] = _seeded(to_jsonable_python(field.get_default(call_default_factory=True)))
    return values


def _seeded(values: Any) -> Any:
    """The same with the seed of a part following the seed of the run."""
    if not isinstance(values, dict):
        return values
    return {name: "${seed}" if name == "seed" else _seeded(value) for name, value in values.items()}


def _completed(values: Any) -> Any:
    if isinstance(values, list):
        return [_completed(value) for value in values]
    if not isinstance(values, dict):
        return values
    target = values.get("_target_")
    own = {name: value for name, value in values.items() if name != "_target_"}
    made_of_parts = own and all(isinstance(value, dict) and "_target_" in value for value in own.values())
    if target is not None and target.partition(".")[0] in OWN_PACKAGES and not made_of_parts:
        values = _merged({"_target_": target, **_target_defaults(target)}, own)
    return {name: _completed(value) for name, value in values.items()}


def _merged(under: Any, over: Any) -> Any:
    """Nested plain values with others over them; unlike OmegaConf's merge, `???` takes a value away."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    return under | {name: _merged(under.get(name), value) for name, value in over.items()}


def _target_defaults(target: str) -> dict[str, Any]:
    from hydra.utils import get_object

    try:
        made = get_object(target)
    except Exception:  # whatever importing it raises: it is told when the object is made
        return {}
    if isinstance(made, type) and issubclass(made, pydantic.BaseModel):
        return _seeded(model_defaults(made))
    parameters = inspect.signature(made).parameters.values()
    defaults = {each.name: "???" if each.default is each.empty else each.default for each in parameters}
    return _seeded(to_jsonable_python(defaults))


def _keys(recipe: DictConfig) -> set[str]:
    return {key for key, _ in nested_items(OmegaConf.to_container(recipe))}


def _in_target(values: Any, key: str) -> bool:
    """Whether a key that the values do not have may be one of a class that they name by ``_target_``."""
    for part in key.split(".")[:-1]:
        values = values.get(part) if isinstance(values, Mapping) else None
        if isinstance(values, Mapping) and "_target_" in values:
            return True
    return False


def complete(recipe: DictConfig) -> DictConfig:
    """The recipe with the defaults of our own classes that it names by `_target_`, which are imported.

    An object made of such objects alone has no settings of its own, and is not looked into.
    """
    return DictConfig(_completed(OmegaConf.to_container(recipe)))


def check(recipe: DictConfig, settings: type[Settings]) -> Settings:
    """Resolve a composed recipe and validate it with its pydantic model.

    Raises:
        TronError: a required key has no value, or a key is unknown or of the wrong type; the first of them
            is named.
    """
    _validated(recipe, settings)  # before anything is imported for it
    return _validated(complete(recipe), settings)


def _validated(recipe: DictConfig, settings: type[Settings]) -> Settings:
    for key, value in nested_items(OmegaConf.to_container(recipe)):
        if value == "???":
            raise _required(key)
    values = resolve(recipe)
    try:
        return settings.model_validate(values)
    except pydantic.ValidationError as error:
        raise _one_line(error, values, settings) from error


def resolve(recipe: DictConfig) -> Any:
    """The recipe as nested dicts and lists, with every interpolation replaced by its value.

    Raises:
        TronError: an interpolation names a key that does not exist or has no value.
    """
    try:
        return OmegaConf.to_container(recipe, resolve=True)
    except OmegaConfBaseException as error:
        raise TronError(_first_line(error)) from error


def group_options(config_module: str, config_dir: Path | None = None) -> dict[str, dict[str, str]]:
    """Groups of a configuration folder, their options, and what is said of each: its first comment line.

    Options of the user's own folder come behind the package's.
    """
    root = resources.files(config_module)
    with _loader(config_module) as loader:
        options = {group: _options(loader, group, config_dir) for group in _groups(loader)}
    listed = yaml.safe_load(root.joinpath("config.yaml").read_text("utf-8")).get("defaults", ())
    chosen = {group: name for each in listed if isinstance(each, dict) for group, name in each.items()}

    def describe(group: str, name: str) -> str:
        path = root.joinpath(group, f"{name}.yaml")
        own = path if path.is_file() or config_dir is None else config_dir / group / f"{name}.yaml"
        comment = _comment(own.read_text("utf-8"))
        return f"{comment} (default)".strip() if chosen.get(group) == name else comment

    described = {group: {name: describe(group, name) for name in names} for group, names in options.items()}
    shared = {name: comment for name, (_, comment) in _shared_options(config_module).items()}
    return described | ({SHARED_GROUP: shared} if shared else {})


def _shared_options(config_module: str) -> dict[str, tuple[dict[str, Any], str]]:
    """Options of the group that commands share: this command's part of the file, and the file's comment."""
    parent, _, command = config_module.rpartition(".")
    folder = resources.files(parent).joinpath(SHARED_GROUP) if parent else None
    found: dict[str, tuple[dict[str, Any], str]] = {}
    for path in folder.iterdir() if folder is not None and folder.is_dir() else ():
        if path.name.endswith(".yaml"):
            text = path.read_text("utf-8")
            parts = yaml.safe_load(text)
            if command in parts:
                found[path.name.removesuffix(".yaml")] = (parts[command], _comment(text))
    return found


def unknown_key(key: str, known: Sequence[str], beside: Sequence[str] = ()) -> TronError:
    """The error for a key that does not exist, with the nearest one that does.

    Args:
        key: dotted.
        known: keys that --help all lists.
        beside: names that could stand in its place, where --help all does not list them.
    """
    if not beside:
        return TronError(f"unknown key '{key}'", mend=f"{did_you_mean(key, known)}--help all lists every key")
    near = did_you_mean(key, [f"{key.rpartition('.')[0]}.{name}" for name in beside])
    return TronError(f"unknown key '{key}'", mend=f"{near}there are {', '.join(beside)}")


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """`"did you mean 'x'? "`, or nothing where no known name is near."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if not near:  # the right leaf under the wrong parent: `frames` for `trajectory.frames`
        leaves = {each.rpartition(".")[2]: each for each in known}
        near = [leaves[leaf] for leaf in difflib.get_close_matches(name.rpartition(".")[2], leaves, n=1)]
    return f"did you mean '{near[0]}'? " if near else ""


@contextmanager
def _loader(config_module: str) -> Iterator[ConfigLoader]:
    with initialize_config_module(config_module, version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def _groups(loader: ConfigLoader) -> list[str]:
    return [name for name in loader.list_groups("") if name != "hydra"]


def _options(loader: ConfigLoader, group: str, config_dir: Path | None) -> list[str]:
    own = sorted(path.stem for path in (config_dir / group).glob("*.yaml")) if config_dir else []
    return [*loader.get_group_options(group), *own]


def _key(text: str) -> str:
    """The key or group of an override, as it is typed before the equals sign."""
    return text.partition("=")[0].lstrip("+~").partition("@")[0].strip()


def _setting(text: str, settings: type[pydantic.BaseModel], values: Mapping[str, Any]) -> Override:
    """Override of a key: a path as it is typed, anything else in Hydra's grammar."""
    typed, equals, value = text.partition("=")
    is_path, several = takes_paths(settings, values, _key(text)) if equals else (False, False)
    path = path_value(value, several) if is_path else None
    if path is None:
        return _parse(text, several)
    quoted = f"[{','.join(map(_quoted, path))}]" if isinstance(path, list) else _quoted(path)
    return _parse(f"{typed}={quoted}")


def _quoted(path: str) -> str:
    """A path as a text in Hydra's grammar, where a backslash before a quote counts, and no other does."""
    return "'" + re.sub(r"(\\*)(?='|$)", r"\1\1", path).replace("'", r"\'") + "'"


def _change(recipe: DictConfig, override: Override) -> None:
    """Change a key of the recipe in place; compose cannot, since the model's keys are in no file it reads."""
    key = override.key_or_group
    if override.is_delete():
        parent, _, leaf = key.rpartition(".")
        node = OmegaConf.select(recipe, parent) if parent else recipe
        if not OmegaConf.is_dict(node) or leaf not in node:
            raise TronError(f"cannot delete '{key}'", mend="there is no such key")
        del node[leaf]
    else:
        added = override.is_add() or override.is_force_add()
        OmegaConf.update(recipe, key, override.value(), merge=True, force_add=added)


def _parse(text: str, several: bool = False) -> Override:
    """Parse in Hydra's grammar; of a setting that takes several values a comma without brackets is told."""
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        key, equals, value = text.partition("=")
        if several and "," in value:
            raise _one_value(key, value) from error
        mend = f"""quote the value: '{key}="{value}"'""" if equals else "write key=value"
        if value[:1] in ("{", "["):  # the quotes belong around the texts in it
            shown = '{name: "text"}' if value[0] == "{" else '["text"]'
            mend = f"quote the texts in it, as in '{key}={shown}'"
        raise TronError(f"cannot read '{text}'", mend=mend) from error
    if override.is_sweep_override():
        key, _, value = text.partition("=")
        raise _one_value(key, value)
    return override


def _one_value(key: str, value: str) -> TronError:
    return TronError(f"'{key}' takes one value", where=value, mend=f"for a list write '{key}=[{value}]'")


def _require_option(override: Override, options: Sequence[str]) -> None:
    value = override.value()
    for name in value if isinstance(value, list) else [value]:
        if name is not None and name not in options:
            group = override.key_or_group
            mend = did_you_mean(str(name), options) + "available: " + ", ".join(options)
            raise TronError(f"unknown {group} '{name}'", mend=mend)


def _one_line(error: pydantic.ValidationError, values: Any, settings: type[pydantic.BaseModel]) -> TronError:
    errors = error.errors()
    # Unknown keys first: a misspelt key often leaves a second error behind, of the key that was meant.
    first = min(errors, key=lambda each: each["type"] != "extra_forbidden")
    if not first["loc"]:  # a rule between several keys: its message names them
        return TronError(first["msg"].removeprefix("Value error, "))
    key = _written_key(first["loc"], values)
    if first["type"] == "extra_forbidden":
        return unknown_key(key, list(field_keys(settings)), _keys_in_list(key, settings))
    # What may be of several types fails as each of them: the error furthest inside a list says most.
    same = [each for each in errors if f"{_written_key(each['loc'], values)}.".startswith(f"{key}.")]
    first = max(same, key=lambda each: (len(_written_key(each["loc"], values)), _wrong_length(each)))
    key = _written_key(first["loc"], values)
    shown = repr(first["input"])
    if len(shown) > SHOWN_CHARACTERS:
        shown = shown[:SHOWN_CHARACTERS] + "..."
    reason = first["msg"].removeprefix("Value error, ")
    reason = reason[:1].lower() + reason[1:]
    if _wrong_length(first) or (first["input"] is not None and any(map(_wants_list, same))):
        as_list = f"a list is written {key}={_list_example(first['loc'], settings) or [first['input']]}"
        plain = _wants_list(first) or first["type"] == "missing"
        return TronError(f"wrong value for '{key}'", shown, as_list if plain else f"{reason}; {as_list}")
    if first["type"] == "missing" or first["input"] is None:
        return _required(key)
    words = [each.get("ctx", {}).get("expected") for each in same if each["type"] == "literal_error"]
    if words and first["type"] != "literal_error":  # a number, or one of some words
        reason += f"; or give {words[0]}"
    return TronError(f"wrong value for '{key}'", where=shown, mend=reason)


def _keys_in_list(key: str, settings: type[pydantic.BaseModel]) -> list[str]:
    """Names of the keys of the model that an unknown key stands in, if that is an item of a list."""
    annotation: Any = settings
    parents = key.split(".")[:-1]
    for part in parents:
        annotation = _member(annotation, None, part)
    if not any(part.isdecimal() for part in parents):
        return []
    models = [each for each in _alternatives(annotation) if isinstance(each, type)]
    return [name for each in models if issubclass(each, pydantic.BaseModel) for name in each.model_fields]


def _wants_list(error: Any) -> bool:
    return error["type"] in ("tuple_type", "list_type")


def _wrong_length(error: Any) -> bool:
    return error["type"] in ("too_short", "too_long") or (
        error["type"] == "missing" and isinstance(error["loc"][-1], int)
    )


def _list_example(location: Sequence[str | int], settings: type[pydantic.BaseModel]) -> str | None:
    """The first example that a settings model's field gives of itself, if it gives one."""
    model: type[pydantic.BaseModel] | None = settings
    field = None
    for part in location:
        found = model.model_fields.get(str(part)) if model else None
        if found is None:
            break
        field, model = found, nested_model(found.annotation)
    return str(field.examples[0]) if field is not None and field.examples else None


def field_keys(model: type[pydantic.BaseModel], prefix: str = "") -> Iterator[str]:
    """Every field of a settings model, dotted, parents before children."""
    for name, field in model.model_fields.items():
        yield f"{prefix}{name}"
        inner = nested_model(field.annotation)
        if inner is not None:
            yield from field_keys(inner, f"{prefix}{name}.")


def nested_model(annotation: Any) -> type[pydantic.BaseModel] | None:
    """The settings model that an annotation holds, `Model` or `Model | None`; None for anything else."""
    union = get_origin(annotation) in (Union, types.UnionType)
    for each in get_args(annotation) if union else (annotation,):
        if isinstance(each, type) and issubclass(each, pydantic.BaseModel):
            return each
    return None


def _required(key: str) -> TronError:
    return TronError(f"'{key}' has no value", mend=f"give {key}=VALUE")


def _written_key(location: Sequence[str | int], values: Any) -> str:
    """The dotted key as the user writes it: pydantic's location also names branches of unions."""
    parts = [str(location[0])]
    inside = values.get(location[0]) if isinstance(values, Mapping) else None
    for part in location[1:]:
        if isinstance(inside, Mapping):
            parts.append(str(part))
            inside = inside.get(part)
        elif isinstance(inside, list) and isinstance(part, int) and part < len(inside):
            parts.append(str(part))
            inside = inside[part]
    return ".".join(parts)


def _comment(text: str) -> str:
    lines = [line.lstrip("# ").strip() for line in text.splitlines() if line.startswith("#")]
    return next((line for line in lines if line and not line.startswith("@package")), "")


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


_QUOTED = re.compile(r"""(["']).*\1""", re.DOTALL)
_QUOTED_ITEM = re.compile(r"""(^|,)\s*["']""")


def path_value(value: str, several: bool) -> str | list[str] | None:
    """The path or paths that a typed value names, ``~`` expanded; None where Hydra's grammar holds.

    Args:
        value: right of the equals sign.
        several: whether the setting takes a list of paths. ``a,b`` without brackets is then no path, unless
            there is a file of this name.
    """
    if value.strip() in ("", "null") or "${" in value or _QUOTED.fullmatch(value.strip()):
        return None
    if several and not Path(value).exists():
        inner = value.strip()[1:-1]
        if value.strip() == f"[{inner}]":
            return None if not inner or _QUOTED_ITEM.search(inner) else list(map(_expanded, inner.split(",")))
        if "," in value:
            return None
    return _expanded(value)


def takes_paths(settings: type[pydantic.BaseModel], recipe: Mapping[str, Any], key: str) -> tuple[bool, bool]:
    """Whether a setting is a path, and whether it may be several.

    Args:
        settings: model of the whole recipe.
        recipe: composed values, whose ``_target_`` say what the model leaves open.
        key: dotted, as it is typed.
    """
    annotation: Any = settings
    node: Any = recipe
    for part in key.split("."):
        annotation = _member(annotation, node, part)
        node = node.get(part) if isinstance(node, Mapping) else None
    kinds = _alternatives(annotation)
    several = any(Path in _alternatives(inner) for kind in kinds for inner in _items(kind))
    return Path in kinds or several, several


def _expanded(value: str) -> str:
    """The value: as it is where there is such a file, else without outer blanks and with a home for ``~``."""
    return value if Path(value).exists() else os.path.expanduser(value.strip())  # a URL keeps its slashes


def _member(annotation: Any, node: Any, part: str) -> Any:
    """Annotation of one part of what has this annotation and this value; None where nothing says it."""
    for kind in _alternatives(annotation):
        if isinstance(kind, type) and issubclass(kind, pydantic.BaseModel):
            return kind.model_fields[part].annotation if part in kind.model_fields else None
        if get_origin(kind) is dict and get_args(kind)[1] is not Any:
            return get_args(kind)[1]
        if get_origin(kind) in (list, tuple) and part.isdecimal():
            return get_args(kind)[0]
    target = node.get("_target_") if isinstance(node, Mapping) else None
    return None if target is None else _parameter(str(target), part)


def _parameter(target: str, name: str) -> Any:
    """Annotation of a field or parameter of what ``_target_`` names; None where it has none."""
    from hydra.utils import get_object

    try:
        return get_type_hints(get_object(target)).get(name)
    except Exception:  # whatever importing it raises: it is told when the object is made
        return None


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """Members of a union, without what ``Annotated`` adds; the annotation alone if it is none."""
    if get_origin(annotation) is Annotated:
        return _alternatives(get_args(annotation)[0])
    if get_origin(annotation) is not None and get_origin(annotation) not in (list, tuple, dict):
        return tuple(each for inner in get_args(annotation) for each in _alternatives(inner))
    return (annotation,)


def _items(kind: Any) -> tuple[Any, ...]:
    return get_args(kind)[:1] if get_origin(kind) in (list, tuple) else ()

"""Names whose home is imported when they are asked for, so that help and mistakes wait for no library."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, get_args

from pydantic_core import PydanticKnownError, core_schema


def lazily(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose public names lie in modules of it.

    Args:
        package: its name.
        homes: module, relative to the package -> its public names, with blanks between them.
    """
    modules = {name: module for module, names in homes.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return find


def later(module: str, name: str) -> Callable[..., Any]:
    """Return a function of a module that is imported once the function is called."""
    return partial(_call, module, name)


def _call(module: str, name: str, *arguments: Any) -> Any:
    return getattr(import_module(module), name)(*arguments)


class OneOf:
    """What ``Annotated[str, OneOf(module, name)]`` makes of a text: one of the words of a ``Literal`` there.

    It is checked, refused and shown as the ``Literal`` itself, which is imported for this and no earlier.
    """

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def words(self) -> tuple[str, ...]:
        """Return the words that it may be."""
        return get_args(getattr(import_module(self.module), self.name))

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        """Return the schema of one of the words."""
        return core_schema.no_info_plain_validator_function(self._checked)

    def _checked(self, value: Any) -> Any:
        words = self.words()
        if value not in words:
            *first, last = map(repr, words)
            raise PydanticKnownError("literal_error", {"expected": f"{', '.join(first)} or {last}"})
        return value

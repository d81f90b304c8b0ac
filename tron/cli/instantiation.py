"""Objects that a recipe names by ``_target_``: made by Hydra, with their mistakes as one line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pydantic

from tron.errors import TronError


def make(recipe: Mapping[str, Any], key: str, where: str | None = None) -> Any:
    """Make the object that a recipe's ``_target_`` names.

    Args:
        recipe: nested plain values.
        key: of the recipe in the settings, such as "prior"; messages name it.
        where: what else a message should name, such as an address.

    Raises:
        TronError: the class does not exist, does not take these values, or refused them.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    try:
        return instantiate(recipe, _convert_="all")
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, TronError):
            raise cause from error
        if isinstance(cause, pydantic.ValidationError):
            first = cause.errors()[0]
            inner = re.search(r"^full_key: (\S+)$", str(error), re.MULTILINE)  # of a part within the recipe
            parts = (key, *(inner.groups() if inner else ()), *first["loc"])
            wrong = ".".join(str(part) for part in parts)
            raise TronError(f"wrong value for '{wrong}'", repr(first["input"])[:80], first["msg"]) from error
        reason = str(cause).splitlines()[0].rstrip(":")
        mend = f"see {key}=NAME in --help"
        if "No module named" in str(cause):
            mend = "a module of yours must be on Python's path: PYTHONPATH=FOLDER"
        raise TronError(f"{key} cannot be made: {reason}", where, mend) from error

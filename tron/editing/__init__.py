"""Change a scene: selections and edits as data, to be stored, replayed, undone and merged.

    from tron.editing import Material, Remove, Selection, Session

A mesh model joins as one more kind of edit (:mod:`tron.editing.edits`), once it can be made of surfels.
"""

from typing import TYPE_CHECKING

from tron.lazily import lazily

if TYPE_CHECKING:
    from tron.editing.edit_list import EditList, Session
    from tron.editing.edits import Duplicate, Edit, Insert, Material, Move, Remove, Separate
    from tron.editing.selections import Box, Clicks, Grown, MaterialRange, Selection, Sphere
    from tron.editing.views import Views

__all__ = [
    "EditList",
    "Session",
    "Edit",
    "Remove",
    "Move",
    "Duplicate",
    "Separate",
    "Insert",
    "Material",
    "Selection",
    "Box",
    "Sphere",
    "MaterialRange",
    "Grown",
    "Clicks",
    "Views",
]

__getattr__ = lazily(
    __name__,
    {
        "edit_list": "EditList Session",
        "edits": "Duplicate Edit Insert Material Move Remove Separate",
        "selections": "Box Clicks Grown MaterialRange Selection Sphere",
        "views": "Views",
    },
)

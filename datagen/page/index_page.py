"""index.html: the template, its style and its script with what they need to know, in one file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from string import Template
from typing import Any

import numpy as np

from datagen.clip_preview import CODES, LOG2_RANGE
from datagen.clip_rows import ClipRow
from tron.color import AGX_INSET, AGX_LOG2_RANGE, agx

AGX_SAMPLES = 1024
"""Intervals of the table of AgX's curve; between them the page interpolates, to 1e-5."""


def index_page(title: str, rows: Sequence[ClipRow], links: Mapping[str, str]) -> str:
    """The page, the same bytes for the same clips.

    Args:
        title: of the page.
        rows: the clips, in the order in which they are shown at first.
        links: name -> file beside the page.
    """
    folder = resources.files("datagen.page")
    read = {name: folder.joinpath(f"index.{name}").read_text("utf-8") for name in ("html", "css", "js")}
    data = {"clips": [row.model_dump(mode="json") for row in rows], "tone": tone_tables()}
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return Template(read["html"]).substitute(
        title=escape(title),
        style=read["css"],
        links=" · ".join(f'<a href="{escape(file)}">{escape(name)}</a>' for name, file in links.items()),
        data=text,
        script=read["js"],
    )


def tone_tables() -> dict[str, Any]:
    """Tables that the page computes display values by: AgX from ``tron.color``, and the code of previews."""
    stops = np.linspace(*AGX_LOG2_RANGE, AGX_SAMPLES + 1)
    curve = agx(np.repeat(2.0 ** stops[:, None], 3, axis=1))[:, 0]  # a grey is the same after the inset
    return {
        "agx_inset": AGX_INSET,
        "agx_range": AGX_LOG2_RANGE,
        "agx": [round(float(value), 6) for value in curve],
        "log2_range": LOG2_RANGE,
        "codes": CODES,
    }

"""Page -> one HTML file: pictures as data URIs, style inline, no script, nothing fetched."""

from __future__ import annotations

import base64
import io
from importlib import resources
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup
from PIL import Image

from tron.images import encode_png
from tron.report.page import Page
from tron.storage import write_atomic

LOSSLESS_PIXELS = 256 * 256
"""Up to this size a picture is stored as PNG; a larger one as JPEG, which keeps the page light."""


def data_uri(image: np.ndarray) -> str:
    """An image (H, W, 3) in [0, 1] as a ``data:`` URI: PNG or, when large, JPEG of quality 92."""
    clipped = np.clip(image, 0, 1)
    if image.shape[0] * image.shape[1] <= LOSSLESS_PIXELS:
        return "data:image/png;base64," + base64.b64encode(encode_png(clipped)).decode()
    buffer = io.BytesIO()
    Image.fromarray(np.round(clipped * 255).astype(np.uint8)).save(buffer, "JPEG", quality=92, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def film_uri(video: bytes) -> str:
    """An MP4 as a ``data:`` URI."""
    return "data:video/mp4;base64," + base64.b64encode(video).decode()


def render(page: Page) -> str:
    """The page as HTML; every text in it is escaped."""
    folder = resources.files("tron.report")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"data_uri": data_uri, "film_uri": film_uri}
    template = environment.from_string(folder.joinpath("page.html.j2").read_text("utf-8"))
    style = Markup(folder.joinpath("style.css").read_text("utf-8"))
    return template.render(page=page, style=style)


def write_report(page: Page, path: str | Path) -> None:
    """Write the page whole or not at all; TronError if the folder cannot be written."""
    write_atomic(path, render(page))

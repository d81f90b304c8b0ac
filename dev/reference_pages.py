"""MkDocs hook that makes reference/: commands and settings from `--help all`, Python from docstrings."""

import html
import logging
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
MODULES = {
    "Scenes and cameras": ["tron.cameras", "tron.trajectories", "tron.gaussians"],
    "Light": ["tron.relighting", "tron.shading", "tron.estimation"],
    "Editing": ["tron.editing"],
    "Rays": ["tron.tracing", "tron.tracing.torch_bridge", "tron.integrators"],
    "Captures and reconstruction": ["tron.captures", "tron.reconstruction", "tron.reconstruction.priors"],
    "Neural renderer": ["tron.neural.renderer", "tron.neural.weights", "tron.neural.shipped"],
    "Datasets": ["tron.shards", "tron.shards.schema", "tron.flow", "tron.metrics"],
    "Ground floor": ["tron.color", "tron.io.images", "tron.seeds", "tron.storage", "tron.runtime"],
}
KEY = re.compile(r"^(?:  |    )([\w.]+(?:\.\*)?)(?:=(.*?))?(?: {3}\[(.*)\])?$")
PARAGRAPHS = re.compile(r"^(?=usage:|keys \(|\S+=NAME$|options$|examples$)", re.MULTILINE)


# Docstrings write arrays as a[i][j], which Markdown takes for references.
logging.getLogger("mkdocs.plugins.mkdocs_autorefs").setLevel(logging.ERROR)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    pages = help_pages()
    for name, content in {
        "commands": commands(pages),
        "settings": settings(pages),
        "python": python(),
    }.items():
        files.append(File.generated(config, f"reference/{name}.md", content=content))
    return files


def help_pages() -> dict[str, str]:
    """Command -> what its `--help all` prints, without the line on what is installed here."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    pages = {}
    for name, entry in scripts.items():
        module, _, function = entry.partition(":")
        program = f"from {module} import {function}; {function}(['--help', 'all'])"
        done = subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"COLUMNS": "110", "PYTHONPATH": path},
        )
        pages[name] = done.stdout.partition("\n\n")[2]
    return pages


def commands(pages: dict[str, str]) -> str:
    """What each command does, its recipes, options and examples."""
    text = ["# Commands", "", "Made from `--help all`. The keys are in [Settings](settings.md)."]
    for name, page in pages.items():
        purpose, *parts = PARAGRAPHS.split(page)
        shown = [part.rstrip() for part in parts if not part.startswith("keys (")]
        text += ["", f"## {name}", "", purpose.strip(), "", "```text", "\n\n".join(shown), "```"]
    return "\n".join(text) + "\n"


def settings(pages: dict[str, str]) -> str:
    """A table of keys for each command."""
    text = ["# Settings", "", "Made from `--help all`. `N` stands for the index of an item of a list."]
    for name, page in pages.items():
        (keys,) = (part for part in PARAGRAPHS.split(page) if part.startswith("keys ("))
        text += ["", f"## {name}", "", "| key | type | default | what it is |", "|---|---|---|---|"]
        for key, kind, default, meaning in entries(keys):
            cells = (f"`{key}`", kind, f"`{default}`" if default else "", meaning)
            text.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(text) + "\n"


def entries(keys: str) -> Iterator[tuple[str, str, str, str]]:
    """Key, type, default and meaning of each entry of a help page."""
    rows: list[list[str]] = []
    for line in keys.splitlines()[1:]:
        if found := KEY.match(line):
            rows.append([found[1], html.escape(found[3] or ""), (found[2] or "").replace("`", ""), ""])
        elif line.strip():
            rows[-1][3] = f"{rows[-1][3]} {html.escape(line.strip())}".strip()
    yield from ((key, kind, default, meaning) for key, kind, default, meaning in rows)


def python() -> str:
    """Directives of mkdocstrings; a module that is not there ends the build."""
    text = ["# Python", "", "Made from docstrings. Arrays at rest are NumPy float32."]
    for title, modules in MODULES.items():
        text += ["", f"## {title}"]
        for module in modules:
            text += ["", f"::: {module}"]
    return "\n".join(text) + "\n"

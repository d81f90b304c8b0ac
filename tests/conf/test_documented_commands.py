"""Every command in a block of README and docs composes, with keys and values that it knows."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from hydra.utils import get_object

from tron.cli.recipes import check, compose_recipe

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
BLOCK = re.compile(r"^```\w*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
EXAMPLES = ("train.lights=[moon]",)
"""What docs/contributing.md adds first."""


def commands(page: Path) -> list[str]:
    """Those that need no shell to be read."""
    blocks = "".join(BLOCK.findall(page.read_text("utf-8"))).replace("\\\n", " ")
    lines = [line for line in blocks.splitlines() if line.startswith("tron-")]
    return [line for line in lines if "$" not in line and not any(each in line for each in EXAMPLES)]


DOCUMENTED = [page for page in PAGES if commands(page)]


def test_blocks_are_found():
    assert len(DOCUMENTED) > 10
    assert sum("outputs/toy_" in line for page in PAGES for line in commands(page)) == 2


@pytest.mark.parametrize("page", DOCUMENTED, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_commands_of_a_page_compose(page: Path):
    for line in commands(page):
        program, *words = shlex.split(line, comments=True)
        folder = None
        if "--config-dir" in words:
            place = words.index("--config-dir")
            folder = ROOT / words[place + 1]
            del words[place : place + 2]
        command = get_object(SCRIPTS[program].replace(":", ".")).load()
        try:
            check(compose_recipe(command.config_module, command.settings, words, folder), command.settings)
        except Exception as error:
            raise AssertionError(line) from error

"""Every command in a block of docs/data.md composes, with keys and values that it knows."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from hydra.utils import get_object

from tron.cli.recipes import check, compose_recipe

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PAGE = ROOT / "docs/data.md"
BLOCK = re.compile(r"^```\w*\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def commands() -> list[str]:
    blocks = "".join(BLOCK.findall(PAGE.read_text())).replace("\\\n", " ")
    return [line for line in blocks.splitlines() if line.startswith("tron-")]


def test_blocks_are_found():
    assert len(commands()) > 10
    assert sum("outputs/toy_" in each for each in commands()) == 2


@pytest.mark.parametrize("line", commands())
def test_a_command_composes(line: str):
    program, *words = shlex.split(line, comments=True)
    command = get_object(SCRIPTS[program].replace(":", ".")).load()
    check(compose_recipe(command.config_module, command.settings, words), command.settings)

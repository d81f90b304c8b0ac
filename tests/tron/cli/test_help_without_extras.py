"""`--help` of every command in environments that lack its extra; test_wheel.py does so in a real one."""

import json
import subprocess
import sys

import pytest

PROGRAM = """
import contextlib, importlib.metadata as metadata, io, json, sys
from importlib.machinery import PathFinder
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

wanted = json.loads(sys.argv[1])
found, todo = set(), [("tron-relight", extra) for extra in ("", *wanted)]
while todo:
    name, extra = todo.pop()
    found.add(canonicalize_name(name))
    for each in map(Requirement, metadata.requires(name) or ()):
        if each.marker is None or each.marker.evaluate({"extra": extra}):
            for inner in {"", *each.extras}:
                if canonicalize_name(each.name) not in found or inner:
                    todo.append((each.name, inner))
owners = metadata.packages_distributions()
version = metadata.version

class Installed(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        of = owners.get(name.partition(".")[0])
        if of and not any(canonicalize_name(each) in found for each in of):
            return None
        return PathFinder.find_spec(name, path, target)

def installed_version(name):
    if canonicalize_name(name) not in found:
        raise metadata.PackageNotFoundError(name)
    return version(name)

sys.meta_path[sys.meta_path.index(PathFinder)] = Installed
metadata.version = installed_version
from tron.cli import installation

pages = {}
for command in ("relight", "edit", "bake", "view", "reconstruct", "datagen", "train", "evaluate"):
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        getattr(installation, command)(["--help", "all"])
    pages[command] = out.getvalue()
print(json.dumps(pages))
"""


def pages(*extras: str) -> dict[str, list[str]]:
    """Lines of the page of each command in an environment with the base and some extras."""
    words = [sys.executable, "-c", PROGRAM, json.dumps(extras)]
    shown = subprocess.run(words, capture_output=True, text=True, check=False)
    assert shown.returncode == 0, shown.stderr
    return {name: page.splitlines() for name, page in json.loads(shown.stdout).items()}


def test_the_base_alone_shows_every_command_and_names_its_extra():
    shown = pages()
    for command, key in {"relight": "scene", "edit": "edits", "bake": "rotation", "view": "port",
                         "reconstruct": "capture",
                         "datagen": "train.scenes", "train": "stages",
                         "evaluate": "benchmark.*"}.items():  # fmt: skip
        name = "eval" if command == "evaluate" else command
        extra = "relight" if command in ("edit", "bake") else name
        head, *page = shown[command]
        assert head.startswith(f"needs pip install 'tron-relight[{extra}]'; not installed here: ")
        assert f"usage: tron-{name} [key=value ...] [group=option ...]" in page
        assert any(line.startswith(f"  {key}") for line in page), page


@pytest.mark.long
def test_no_environment_shows_less_than_another():
    whole = pages("eval", "view")
    assert all(page[0].endswith(", which is installed") for page in whole.values())
    for extras in ((), ("relight",), ("train",), ("datagen",)):
        shown = pages(*extras)
        for command, page in whole.items():
            assert shown[command][1:] == page[1:], (extras, command)

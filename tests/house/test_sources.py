"""What the sources may not hold: chance that no seed governs, drawers of leftovers, unreadably long files."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tron", "datagen", "train", "eval", "conf")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
SEEDS = ROOT / "tron" / "seeds.py"

CHANCE_MODULES = {"random", "uuid", "secrets"}
CHANCE_CALLS = {"os.urandom", "torch.seed", "torch.initial_seed"}
WALL_CLOCKS = {"time.time", "time.time_ns", "time.ctime", "time.localtime", "time.gmtime", "time.strftime"}
WALL_CLOCKS |= {
    f"datetime.{name}" for name in ("datetime.now", "datetime.utcnow", "date.today", "now", "utcnow")
}
CLOCKS = WALL_CLOCKS | {"time.perf_counter", "time.perf_counter_ns", "time.monotonic", "time.process_time"}
# Types and constructors of explicit streams; everything else in np.random shares one hidden state.
EXPLICIT = {"Generator", "SeedSequence", "PCG64", "Philox", "BitGenerator"}
SEEDED = ("seed", "generator", "integer", "default_rng", "Random", "SeedSequence", "PCG64", "Philox")


def offences(source: str) -> list[str]:
    """Uses of randomness or clocks that would make two runs differ, as `line: what`."""
    tree = ast.parse(source)
    imported = dict(_imports(tree))
    return sorted({f"{node.lineno}: {what}" for node, what in _offences(tree, imported)})


def _imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """(local name, full name) of everything imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield (
                    alias.asname or alias.name.split(".")[0],
                    alias.name if alias.asname else alias.name.split(".")[0],
                )
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                yield (alias.asname or alias.name, f"{node.module}.{alias.name}")


def _full_name(node: ast.AST, imported: dict[str, str]) -> str:
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return ""
    return ".".join([imported.get(node.id, node.id), *reversed(parts)])


def _offences(tree: ast.AST, imported: dict[str, str]) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in CHANCE_MODULES:
                    yield node, alias.name
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in CHANCE_MODULES:
            yield node, node.module or ""
        elif isinstance(node, ast.Attribute | ast.Name):
            name = _full_name(node, imported)
            hidden_state = name.startswith("numpy.random.") and name.split(".")[2] not in EXPLICIT
            if hidden_state or name in CHANCE_CALLS or name in WALL_CLOCKS:
                yield node, name
        elif isinstance(node, ast.Call):
            function = _full_name(node.func, imported).rpartition(".")[2]
            keywords = [word.value for word in node.keywords if word.arg and "seed" in word.arg]
            arguments = [*node.args, *keywords] if any(part in function for part in SEEDED) else keywords
            for inner in (each for argument in arguments for each in ast.walk(argument)):
                if isinstance(inner, ast.Call) and _full_name(inner.func, imported) in CLOCKS:
                    yield node, "a clock as a seed"


@pytest.mark.parametrize(
    "source",
    [
        "import random",
        "from random import shuffle",
        "import uuid as names",
        "import numpy as np\nnp.random.seed(0)",
        "import numpy as np\nnp.random.default_rng()",
        "import numpy\nx = numpy.random.rand(3)",
        "from numpy.random import randn\nrandn(3)",
        "from numpy import random as r\nr.shuffle([])",
        "import os\nos.urandom(4)",
        "import time\nt = time.time()",
        "from time import time\nt = time()",
        "from datetime import datetime\ndatetime.now()",
        "import time, torch\ntorch.manual_seed(int(time.perf_counter()))",
        "import time\nfit(seed=time.monotonic())",
    ],
)
def test_the_check_catches(source):
    assert offences(source)


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np\ndef f(rng: np.random.Generator): return rng.random()",
        "import time\nstart = time.perf_counter()",
        "import torch\ntorch.manual_seed(3)",
        "from tron.seeds import generator\ngenerator(0, 'lens').uniform()",
    ],
)
def test_the_check_lets_pass(source):
    assert not offences(source)


def test_all_chance_comes_from_seeds():
    found = {
        str(path.relative_to(ROOT)): offences(path.read_text("utf-8")) for path in SOURCES if path != SEEDS
    }
    assert {path: lines for path, lines in found.items() if lines} == {}


LIGHTS_BY_HAND = re.compile(
    r"BounceTransport\.trace\(|[Tt]ransport\.bake\(|\.bake\(light(?:ing)?\b|\.sided\("
)
OWN_LIGHT = ("tron/relighting/", "tron/shading/", "tron/tracing/", "tron/integrators/")
OWN_RAYS = {"tron/reconstruction/light/fit_environment.py"}
"""Fits a light through an occluder that may be a closed form."""


def test_only_the_relighter_traces_bounces_bakes_light_and_picks_sides():
    """Two calls that have to be given the same Estimation are made in one place."""
    files = [*SOURCES, *(ROOT / "examples").rglob("*.py"), *(ROOT / "dev").rglob("*.py"), ROOT / "README.md"]
    found = {str(path.relative_to(ROOT)): LIGHTS_BY_HAND.findall(path.read_text("utf-8")) for path in files}
    by_hand = {name for name, calls in found.items() if calls and not name.startswith(OWN_LIGHT)}
    assert by_hand == OWN_RAYS


def test_no_file_is_a_drawer_for_leftovers():
    drawers = {"utils", "util", "helpers", "helper", "common", "misc"}
    found = [path for path in SOURCES if drawers & {path.stem, *path.relative_to(ROOT).parts}]
    assert found == []


def test_no_file_is_longer_than_800_lines():
    files = [*SOURCES, *(ROOT / "tests").rglob("*.py")]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text("utf-8").splitlines()) for path in files}
    assert {name: lines for name, lines in lengths.items() if lines > 800} == {}


def test_what_runs_a_module_stands_last_in_it():
    """Else ``python -m`` runs it before the functions below are there."""
    guarded = {
        path: [isinstance(node, ast.If) and "__name__" in ast.unparse(node.test) for node in tree.body]
        for path in SOURCES
        for tree in [ast.parse(path.read_text("utf-8"))]
    }
    assert any(any(guards) for guards in guarded.values())
    assert [str(path) for path, guards in guarded.items() if any(guards[:-1])] == []


IMPORTERS = {ROOT / "tron" / "cli" / "installation.py", ROOT / "tron" / "lazily.py"}
"""Commands are looked at before they are imported: a table names them, above all floors. Callers of the other
are looked at themselves."""


def named_imports(source: str, module: str) -> list[str]:
    """Imports by a string, unseen by import-linter, as `line: what`: of ours, but for the own package."""
    found, tree = [], ast.parse(source)
    seen = {"__name__"} | {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not node.args:
            continue
        name = ast.unparse(node.func).rpartition(".")[2]
        if name not in ("import_module", "__import__", "run_module", "lazily", "later", "OneOf"):
            continue
        what = ast.unparse(node.args[0]).removeprefix("f").strip("'\"")
        of_own = what.startswith(("{__name__}.", f"{module.rpartition('.')[0]}."))
        known = isinstance(node.args[0], ast.Constant) and what.partition(".")[0] not in PACKAGES
        if not (of_own or known or what in seen):
            found.append(f"{node.lineno}: {what}")
    return found


@pytest.mark.parametrize(
    ("source", "caught"),
    [
        ("from importlib import import_module\nimport_module('tron.apps.view').show()", True),
        ("import importlib\nimportlib.import_module(name)", True),
        ("__import__('eval.cli')", True),
        ("import_module(f'tron.apps.{name}')", True),
        ("later('tron.apps.view', 'show')", True),
        ("lazily('tron.apps', {'view': 'show'})", True),
        ("lazily(__name__, {'view': 'show'})", False),
        ("from datagen.world.lights import Family\nOneOf('datagen.world.lights', 'Family')", False),
        ("import_module(f'{__name__}.writer')", False),
        ("import_module('tron.relighting.proxy')", False),
        ("import_module('pxr.Sdf')", False),
    ],
)
def test_the_check_of_imports_by_a_string(source, caught):
    assert bool(named_imports(source, "tron.relighting.relighter")) == caught


def test_nothing_is_imported_by_a_string_from_another_package_of_ours():
    found = {
        str(path.relative_to(ROOT)): named_imports(
            path.read_text("utf-8"), ".".join(path.relative_to(ROOT).with_suffix("").parts)
        )
        for path in SOURCES
        if path not in IMPORTERS
    }
    assert {path: lines for path, lines in found.items() if lines} == {}

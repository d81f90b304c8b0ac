"""The house has a budget of lines and files: growth needs a commit that says what for.

Whoever raises a number says in the commit what the room is for; whoever clears up lowers it. Lines and files
are those of Python, whole. eval, datagen, tron/shading and tron/brdf have room for branches under way.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CODE = {
    "tron": (3_010, 19),
    "tron/apps": (3_575, 24),
    "tron/brdf": (800, 7),
    "tron/captures": (5_175, 34),
    "tron/cli": (1_585, 8),
    "tron/editing": (2_080, 13),
    "tron/gaussians": (3_745, 27),
    "tron/integrators": (1_000, 5),
    "tron/io": (3_785, 21),
    "tron/meshing": (350, 3),
    "tron/models": (2_210, 13),
    "tron/neural": (2_380, 22),
    "tron/reconstruction": (6_815, 35),
    "tron/relighting": (1_355, 6),
    "tron/report": (650, 5),
    "tron/scans": (830, 5),
    "tron/shading": (4_840, 24),
    "tron/shards": (1_960, 10),
    "tron/tracing": (4_800, 23),
    "tron/view": (2_660, 13),
    "conf": (50, 12),
    "datagen": (20_050, 129),
    "train": (3_290, 22),
    "eval": (18_400, 122),
}
"""Package -> its lines, its files."""
TESTS = {
    "tests/conf": 600,
    "tests/datagen": 10_240,
    "tests/eval": 7_400,
    "tests/examples": 450,
    "tests/field": 3_900,
    "tests/house": 1_240,
    "tests/robustness": 2_500,
    "tests/slurm": 300,
    "tests/train": 3_250,
    "tests/tron": 33_670,
}
"""Tests of a package -> their lines."""
MOST_ROOM = 2_000
"""Lines that a budget may lie above what is there: what was cleared up does not grow back unseen."""


def sources(package: str) -> list[Path]:
    """Python files of a package; of `tron`, those of the ground floor."""
    return sorted((ROOT / package).glob("*.py" if package == "tron" else "**/*.py"))


def lines(package: str) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in sources(package))


def test_every_package_has_a_budget():
    rooms = {path.parent for path in (ROOT / "tron").glob("*/*.py")}
    packages = {str(path.relative_to(ROOT)) for path in rooms} | {"tron", "datagen", "train", "eval", "conf"}
    assert packages == set(CODE)
    assert {str(path.relative_to(ROOT)) for path in (ROOT / "tests").glob("*/") if sources(str(path))} == set(
        TESTS
    )


def test_code_stays_within_its_budget_of_lines_and_files():
    found = {package: (lines(package), len(sources(package))) for package in CODE}
    over = {
        package: (found[package], budget)
        for package, budget in CODE.items()
        if found[package][0] > budget[0] or found[package][1] > budget[1]
    }
    assert over == {}, "clear up first, or raise the number and say in the commit what for"


def test_tests_stay_within_their_budget_of_lines():
    over = {package: (lines(package), most) for package, most in TESTS.items() if lines(package) > most}
    assert over == {}, "clear up first, or raise the number and say in the commit what for"


def test_budgets_follow_what_is_there():
    most = {package: budget[0] for package, budget in CODE.items()} | TESTS
    assert {package: most[package] for package in most if most[package] - lines(package) > MOST_ROOM} == {}

"""The pages that code cites exist; test_pages.py holds what pages link."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("tron", "datagen", "train", "eval", "conf", "examples", "tests")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md")])
CONFIGURATION = sorted((ROOT / "conf").rglob("*.yaml"))
CITED = re.compile(r"\b(?:docs/[\w/-]+|dev/LOG)\.md\b")
NUMBERED = re.compile(r"\bconventions\.md, (\d+)((?: and \d+|, \d+)*)")
# The design of the house is no part of the repository.
UNPUBLISHED = re.compile(
    r"\b(?:facts|guidance|architecture)(?:\.md)?,? (?:section )?\d|\bfacts\.md|(?<!/)guidance\.md"
)


def text_of(path: Path) -> str:
    """Lines joined, so that a citation may wrap."""
    return " ".join(line.strip().lstrip("# ") for line in path.read_text("utf-8").splitlines())


def sections(page: Path) -> set[int]:
    """Numbers of a page's headings: `## 5. Exposure`."""
    return {int(number) for number in re.findall(r"^#+ (\d+)\b", page.read_text("utf-8"), re.MULTILINE)}


def test_the_checks_catch():
    assert CITED.findall("see docs/absent.md") == ["docs/absent.md"]
    assert NUMBERED.search("(conventions.md, 8)")
    assert UNPUBLISHED.search("rays (facts.md 4b)")
    assert UNPUBLISHED.search("QUALITY: guidance.md measured both")


def test_every_page_that_is_cited_exists():
    cited = {
        (name, str(path.relative_to(ROOT)))
        for path in (*SOURCES, *PAGES, *CONFIGURATION)
        if path != Path(__file__)
        for name in CITED.findall(text_of(path))
    }
    assert {name for name, _ in cited}, "something is cited"
    assert [(name, where) for name, where in sorted(cited) if not (ROOT / name).is_file()] == []


def test_every_number_that_is_cited_is_a_section_of_the_conventions():
    numbered = sections(ROOT / "docs/concepts/conventions.md")
    wrong = [
        f"{path.relative_to(ROOT)}: {found[0]}"
        for path in (*SOURCES, *PAGES, *CONFIGURATION)
        if path != Path(__file__)
        for found in NUMBERED.finditer(text_of(path))
        if not {int(number) for number in re.findall(r"\d+", found[1] + found[2])} <= numbered
    ]
    assert numbered
    assert wrong == []


def test_nothing_cites_the_unpublished_design():
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in (*SOURCES, *CONFIGURATION)
        if path != Path(__file__)
        for match in UNPUBLISHED.finditer(text_of(path))
    ]
    assert found == []

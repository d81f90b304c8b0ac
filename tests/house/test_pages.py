"""README and docs: links lead somewhere, the site builds with its reference, files that are named exist."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES += sorted((ROOT / "examples").rglob("*.md"))
LINK = re.compile(r"\]\(([^)\s]+)\)")
NAMED = re.compile(r"`((?:tron|datagen|train|eval|conf|tests|docs|dev|examples)/[\w/.-]+)`")
GENERATED = ("docs/reference/",)


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as MkDocs and GitHub make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def broken(page: Path) -> list[str]:
    found = []
    for link in LINK.findall(page.read_text("utf-8")):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if str(target).startswith(tuple(str(ROOT / each) for each in GENERATED)):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    assert broken(page) == []


def test_the_checks_catch(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("# Here it is\n[a](absent.md) [b](#here-it-is) [c](#there) [d](https://x.org)\n")
    assert broken(page) == ["absent.md", "#there"]


def test_files_that_pages_name_exist():
    named = {(name, page) for page in PAGES for name in NAMED.findall(page.read_text("utf-8"))}
    assert named
    assert sorted(f"{page.name}: {name}" for name, page in named if not (ROOT / name).exists()) == []


def test_every_page_is_in_the_contents_of_the_site():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8")))
    there = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert there == {name for name in listed if not name.startswith("reference/")}


@pytest.mark.long
def test_the_site_builds_and_its_reference_is_that_of_the_code(tmp_path: Path):
    """Strict: a link, an anchor or a page outside the contents is an error."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    settings = (tmp_path / "reference/settings.html").read_text("utf-8")
    assert all(f"<code>{key}</code>" in settings for key in ("surroundings", "test.lights", "splits", "sky"))
    commands = (tmp_path / "reference/commands.html").read_text("utf-8")
    assert "tron-eval" in commands
    assert "experiment=NAME" in commands
    python = (tmp_path / "reference/python.html").read_text("utf-8")
    for each in ("gaussians.GaussianScene", "relighting.Relighter", "reconstruction.priors.MapPrior"):
        assert f'id="tron.{each}"' in python
    assert "EnvironmentMap" in python

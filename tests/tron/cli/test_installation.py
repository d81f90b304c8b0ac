"""Commands check what they stand on before they import it; test_wheel.py does so in real environments."""

import importlib.metadata
import sys
from pathlib import Path

import pytest

from tron.cli import installation
from tron.errors import TronError

REQUIRES = ["numpy>=2", 'tron-relight[light]; extra == "heavy"', 'absent-a>=1; extra == "light"',
            'absent-b; extra == "heavy"', 'pytest; extra == "heavy"']  # fmt: skip


def test_our_own_packages_are_ours():
    installation.require_own_packages(*installation.PACKAGES)


@pytest.mark.parametrize("decoy", ["train.py", "conf/__init__.py"])
def test_a_foreign_package_is_named_and_not_imported(tmp_path: Path, monkeypatch, decoy: str):
    (tmp_path / decoy).parent.mkdir(exist_ok=True)
    (tmp_path / decoy).write_text("raise AssertionError('imported')\n")
    name = decoy.partition("/")[0].removesuffix(".py")
    monkeypatch.syspath_prepend(tmp_path)
    for module in [each for each in sys.modules if each.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, module)
    with pytest.raises(TronError, match=f"hides TRON's own package '{name}'") as refusal:
        installation.require_own_packages("tron.apps", f"{name}.settings")
    assert refusal.value.where == str(tmp_path / decoy.partition("/")[0])
    installation.require_own_packages("tron.apps", "eval")  # what a command does not import does not stop it


def test_an_extra_names_all_that_it_lacks_and_how_to_install_it(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: REQUIRES)
    with pytest.raises(TronError) as refusal:
        installation.require_extra("tron-toy", "heavy")
    assert str(refusal.value) == "tron-toy needs absent-a, absent-b: pip install 'tron-relight[heavy]'"
    with pytest.raises(TronError, match="needs absent-a: "):
        installation.require_extra("tron-toy", "light")
    installation.require_extra("tron-toy", "other")


def test_a_checkout_that_was_never_installed_is_not_refused(monkeypatch):
    monkeypatch.setattr(installation, "DISTRIBUTION", "tron-absent")
    installation.require_extra("tron-toy", "heavy")

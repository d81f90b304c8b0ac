"""Proxies that are filmed in a second."""

import pytest

from tron.relighting import proxy


@pytest.fixture
def short_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer and smaller views than a real scan needs."""
    for name, value in {"VIEWS": 24, "SIDE": 96}.items():
        monkeypatch.setattr(proxy, name, value)

"""Proxies that are filmed in a second."""

import pytest

from tron.relighting import proxy


@pytest.fixture
def short_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer views than a real scan needs."""
    monkeypatch.setattr(proxy, "VIEWS", 24)

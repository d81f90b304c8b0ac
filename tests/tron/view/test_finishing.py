"""What takes the noise out of a picture at rest: laws that hold whatever the network has learnt."""

from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from tron import denoising
from tron.color import agx
from tron.neural import network_gains
from tron.neural.shipped import DEFAULT, installed
from tron.seeds import generator
from tron.view import opening
from tron.view.finishing import Denoised, Drawn

SIDE = 64


class _Past(Exception):
    pass


@pytest.fixture
def frame() -> dict[str, np.ndarray]:
    """A grey wall, half of it in the sun, with 10 % of noise in its light."""
    noise = generator(0, "tests", "finish").normal(1, 0.1, (SIDE, SIDE, 1)).astype(np.float32)
    light = np.where(np.arange(SIDE) < SIDE // 2, 0.2, 1.0).astype(np.float32)[None, :, None]
    whole = np.ones((SIDE, SIDE, 3), np.float32)
    return {
        **{"lit": 0.5 * light * noise * whole, "pbr": 0.5 * whole, "irradiance": light * noise * whole},
        **{"albedo": 0.5 * whole, "surface": (1.0, 0.8, 0.0) * whole, "sampling": (1.0, 0.6, 0.4) * whole},
    }


@pytest.fixture(scope="module")
def network() -> Future[Any]:
    pytest.importorskip("torch")
    if DEFAULT not in installed():
        pytest.skip("the package came without its network")
    loaded: Future[Any] = Future()
    opening._load(loaded, 1)
    return loaded


@pytest.fixture(params=["network", "oidn"])
def finish(request) -> Drawn | Denoised:
    if request.param == "network":
        return Drawn(request.getfixturevalue("network"))
    pytest.importorskip("pyoidn")
    return Denoised("oidn")


def idle() -> None:
    pass


def errors(image: np.ndarray, frame: dict[str, np.ndarray]) -> float:
    """Root mean square from the wall without noise, display values."""
    true = 0.5 * np.where(np.arange(SIDE) < SIDE // 2, 0.2, 1.0)[None, :, None] * np.ones_like(frame["lit"])
    return float(np.sqrt(np.square(agx(image) - agx(true)).mean()))


def test_noise_goes_and_light_stays(finish, frame):
    done = finish(frame, 1.0, idle)
    assert done.shape == frame["lit"].shape
    # What the network has learnt is another noise than this one: that it keeps the light is what counts.
    left = 1.0 if isinstance(finish, Drawn) else 0.6
    assert errors(done, frame) < left * errors(frame["lit"], frame)


def test_its_unit_plays_no_part(finish, frame):
    scaled = frame | {name: 50 * frame[name] for name in ("lit", "pbr", "irradiance")}
    one, other = finish(frame, 2.0, idle), finish(scaled, 2.0 / 50, idle) / 50
    np.testing.assert_allclose(agx(one), agx(other), atol=2 / 255)


def test_it_is_given_up_in_the_middle_and_works_again(finish, frame):
    asked = 0

    def watch() -> None:
        nonlocal asked
        asked += 1
        if asked == (20 if isinstance(finish, Drawn) else 1):
            raise _Past

    with pytest.raises(_Past):
        finish(frame, 1.0, watch)
    before = asked
    again = finish(frame, 1.0, idle)
    assert asked == before, "nobody asks the one that has been given up"
    np.testing.assert_allclose(again, finish(frame, 1.0, idle), rtol=1e-4)


def test_the_network_is_waited_for_no_longer_than_somebody_looks(frame):
    def watch() -> None:
        raise _Past

    with pytest.raises(_Past):
        Drawn(Future())(frame, 1.0, watch)


def test_it_is_chosen_as_checkpoint_auto_chooses(monkeypatch):
    pytest.importorskip("torch")
    gains = {
        "network": {"preview": {128: 1.0}, "final": {128: -1.0, 512: 1.0, 1024: 0.2}},
        "oidn": {"preview": {128: 2.0}, "final": {128: -2.0, 512: 0.3}},
    }
    monkeypatch.setattr(network_gains, "GAINS", gains)
    monkeypatch.setattr(opening, "_load", lambda *_: None)
    monkeypatch.setattr(opening, "installed", lambda: {DEFAULT: None})
    monkeypatch.setattr(denoising, "installed", lambda: ["oidn"])
    finish = opening.finish_of(None)
    assert isinstance(finish(128, 128), Denoised), "a loss where it is small"
    assert isinstance(finish(512, 512), Drawn)
    assert isinstance(finish(1024, 1024), Denoised), "the lesser gain"
    half = denoising.Denoiser(
        "Half", "half", ("normal",), "numpy", "", lambda: lambda lit, normal: lit * normal
    )
    monkeypatch.setitem(denoising.DENOISERS, "half", half)
    monkeypatch.setattr(denoising, "installed", lambda: ["half"])
    halves = opening.finish_of(None)(128, 128)
    assert isinstance(halves, Denoised), "of unknown gains, and the only one"
    assert halves.normals
    frame = {"lit": np.ones((20, 20, 3)), "normal": np.full((20, 20, 3), 0.5)}
    assert (halves(frame, 1.0, idle) == 0.5).all()
    monkeypatch.setattr(denoising, "installed", list)
    assert opening.finish_of(None)(128, 128) is None
    monkeypatch.setattr(opening, "missing_libraries", lambda _: ["torch"])
    assert opening.finish_of(None)(512, 512) is None

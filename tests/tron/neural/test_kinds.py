"""Weights files of networks that are not ours: found by name, never imported by a file."""

import json
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tron.errors import TronError
from tron.neural.configs import GuidedConfig
from tron.neural.kinds import config_class, kind_of, renderer_class
from tron.neural.protocols import Renderer
from tron.neural.weights import load_renderer, require_saved, save_renderer

OWN = Path(__file__).resolve().parents[3] / "examples/own_network"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The example's package, as pip would have installed it, and imported by nobody."""
    info = tmp_path / "site/dilated-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dilated\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[tron.networks]\ndilated = dilated.net:Dilated\n")
    monkeypatch.syspath_prepend(OWN)
    monkeypatch.syspath_prepend(info.parent)
    yield
    for name in ("dilated", "dilated.net"):
        sys.modules.pop(name, None)


def forget():
    for name in ("dilated", "dilated.net"):
        sys.modules.pop(name, None)


@pytest.fixture
def weights(installed, tmp_path) -> Path:
    from dilated.net import Dilated, DilatedConfig  # type: ignore[import-not-found]

    torch.manual_seed(1)
    network = Dilated(DilatedConfig(width=5))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(0, 0.1)
    save_renderer(tmp_path / "r.safetensors", network)
    return tmp_path / "r.safetensors"


def test_an_installed_network_is_found_and_draws_the_same(weights):
    given = {name: torch.rand(1, 3, 2, 9, 7) for name in ("lit", "albedo")}
    before = sys.modules["dilated.net"].Dilated(sys.modules["dilated.net"].DilatedConfig(width=5))
    before.load_state_dict(load_file(weights))
    forget()
    network = load_renderer(weights)
    assert kind_of(network) == "dilated.net:Dilated"
    assert torch.equal(network(given), before(given))


def test_a_file_imports_nothing_that_no_installed_package_declares(tmp_path, monkeypatch):
    """The module is there to be imported, and writes a file where it is."""
    trace = tmp_path / "imported"
    (tmp_path / "hostile.py").write_text(f"open({str(trace)!r}, 'w')\nclass Net: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    header = {"format": "tron-renderer 1", "kind": "hostile:Net", "config": {}}
    save_file({"a": torch.zeros(1)}, tmp_path / "r.safetensors", {"tron": json.dumps(header)})
    with pytest.raises(TronError, match="hostile:Net, a network that no installed package declares"):
        load_renderer(tmp_path / "r.safetensors")
    assert not trace.exists()


@pytest.mark.parametrize("kind", ["os:system", "builtins:eval", "torch.nn:Linear", "neural2", ":", ""])
def test_a_file_names_renderers_alone(kind):
    with pytest.raises(TronError, match="no installed package declares"):
        renderer_class(kind)


class OfAnotherShape(Renderer):
    """Its weights depend on how often it was made."""

    made = 0

    def __init__(self, config: GuidedConfig | None = None):
        super().__init__()
        self.config = config or GuidedConfig()
        OfAnotherShape.made += 1
        self.layer = torch.nn.Linear(OfAnotherShape.made, 1)


class WantsMore(Renderer):
    """It is not made from its settings alone."""

    def __init__(self, config: GuidedConfig, more: int):
        super().__init__()
        self.config = config


def test_what_could_not_be_read_again_is_refused_before_it_is_trained():
    class Local(Renderer):
        config = GuidedConfig()

    assert config_class(Local) is GuidedConfig
    for renderer, said in (
        (Local(), "could not be read again"),
        (OfAnotherShape(), "has another 'layer.weight'"),
        (WantsMore(GuidedConfig(), 2), "cannot be made from its settings alone"),
    ):
        with pytest.raises(TronError, match=said):
            require_saved(renderer)

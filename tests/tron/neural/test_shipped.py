"""The checkpoints of the package are there, are what their names say, and have a model card each."""

import pytest

from tron.errors import TronError
from tron.neural import shipped
from tron.neural.weights import load_renderer
from tron.storage import sha256


@pytest.mark.parametrize("name", shipped.SHIPPED)
def test_a_shipped_checkpoint_is_given_what_its_name_says_and_has_a_card(name: str):
    path = shipped.shipped(name)
    assert set(load_renderer(path).config.guidance) == {
        "pbr",
        "irradiance",
        "sampling",
        *(["lit", "albedo", "surface"] if name == "surfaces" else []),
    }
    assert path.stat().st_size < 8_000_000
    _, _, card = (shipped.FOLDER / "README.md").read_text().partition(f"## `{name}`")
    assert f"sha256 `{sha256(path)[:8]}...`" in card.partition("\n## ")[0]


def test_a_name_is_its_file_and_a_path_itself():
    assert shipped.checkpoint_file("paper") == shipped.shipped("paper")
    assert shipped.checkpoint_file("lit.safetensors").name == "lit.safetensors"


def test_other_names_are_none_of_ours():
    with pytest.raises(TronError, match="no shipped checkpoint is called 'best'"):
        shipped.shipped("best")

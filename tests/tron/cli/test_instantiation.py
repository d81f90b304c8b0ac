"""Objects by ``_target_``: whatever is wrong with their recipe is one line that names the key."""

import pytest
from pydantic import BaseModel, ConfigDict

from tron.cli.instantiation import make
from tron.errors import TronError


class Lens(BaseModel):
    model_config = ConfigDict(extra="forbid")
    fov: float = 40.0


class Shop:
    """What takes a lens, nested, and has its own opinion about the price."""

    def __init__(self, price: float, lens: Lens | None = None) -> None:
        if price < 0:
            raise TronError("price below 0", "price", "ask for money")
        if price == 0:
            raise ValueError("nothing\nis free")
        self.price, self.lens = price, lens


@pytest.fixture
def target(monkeypatch):
    """Where Hydra finds the classes of this file."""
    import sys
    import types

    module = types.ModuleType("toy_shop")
    module.Shop, module.Lens = Shop, Lens  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "toy_shop", module)
    return "toy_shop.Shop"


def lens(**values) -> dict:
    return {"_target_": "toy_shop.Lens", **values}


def test_it_makes_what_the_recipe_names(target):
    shop = make({"_target_": target, "price": 3, "lens": lens(fov=20)}, "shop")
    assert (shop.price, shop.lens) == (3, Lens(fov=20))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"price": -1}, "price below 0 (price): ask for money"),
        ({"price": 0}, "shop cannot be made: nothing (here): see shop=NAME in --help"),
        ({"price": 1, "lens": lens(fov="x")}, "wrong value for 'shop.lens.fov' ('x'): "),
        ({"price": 1, "lens": lens(fow=1)}, "wrong value for 'shop.lens.fow' (1): "),
        ({"prize": 1}, "shop cannot be made: "),
        (
            {"_target_": "no_shop.Shop"},
            "shop cannot be made: Error loading 'no_shop.Shop' (here): a module",
        ),
        ({"price": 1, "_target_": "toy_shop.Shopp"}, "shop cannot be made: "),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(target, values, said):
    with pytest.raises(TronError) as caught:
        make({"_target_": target, **values}, "shop", "here")
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)

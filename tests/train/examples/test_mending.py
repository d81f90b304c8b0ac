"""Samples whose ``lit`` is less wrong than it was: how many, how far, and which are left alone."""

import numpy as np
import torch

from train.examples.augmentation import augmented, mended
from train.examples.framing import Sample
from train.settings import DataSettings
from tron import seeds
from tron.shards.schema import TARGET

NAMES = ("pbr", "irradiance", "lit", "albedo", TARGET)


def sample(display: frozenset[str] = frozenset(), names: tuple[str, ...] = NAMES) -> Sample:
    random = torch.Generator().manual_seed(0)
    return Sample({name: torch.rand(3, 1, 8, 8, generator=random) for name in names}, display)


def weights(share: float, count: int = 400) -> np.ndarray:
    """w of lit = w truth + (1 - w) lit of so many draws, by least squares."""
    given, found = sample(), []
    towards = given.buffers[TARGET] - given.buffers["lit"]
    for number in range(count):
        made = mended(given, seeds.generator(0, "mend", number), share)
        change = made.buffers["lit"] - given.buffers["lit"]
        weight = float((change * towards).sum() / towards.square().sum())
        torch.testing.assert_close(change, weight * towards, atol=1e-6, rtol=0)
        assert all(made.buffers[name] is given.buffers[name] for name in NAMES if name != "lit")
        found.append(weight)
    return np.array(found)


def test_in_a_share_of_samples_lit_is_the_truth_or_between_the_two():
    found = weights(0.4)
    assert abs((found > 0).mean() - 0.4) < 0.08
    whole = found[found > 0] > 1 - 1e-6
    assert abs(whole.mean() - 0.5) < 0.12
    between = found[found > 0][~whole]
    assert between.min() < 0.15
    assert between.max() > 0.85
    assert abs(between.mean() - 0.5) < 0.1


def test_a_truth_in_place_of_lit_is_the_truth_to_the_bit_however_it_is_turned_and_coloured():
    settings = DataSettings(mend=1.0, permute_colors=1.0, exposure=1.0, rotate=1.0, tint=0.3)
    made = [augmented(sample(), seeds.generator(1, "mend", n), 4, settings) for n in range(8)]
    same = [torch.equal(each.buffers["lit"], each.buffers[TARGET]) for each in made]
    assert any(same)
    assert not all(same)


def test_photographs_and_samples_without_lit_stay_and_without_a_share_nothing_is_drawn():
    for given in (sample(frozenset({TARGET})), sample(names=("pbr", "irradiance", TARGET))):
        assert mended(given, seeds.generator(0, "mend"), 1.0) is given
    plain, drawn = seeds.generator(0, "mend"), seeds.generator(0, "mend")
    given = sample()
    assert mended(given, drawn, 0.0) is given
    assert plain.random() == drawn.random()

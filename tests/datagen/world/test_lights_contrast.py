"""Contrast: three classes by one measure, and lights drawn by it."""

from collections import Counter

import numpy as np
import pytest

from datagen.world.lights import EVERY, FAMILIES, HdriSpec, classify, contrast_share, draw_light
from datagen.world.lights.light import Disc, lay
from datagen.world.scene import SceneSpec, draw_scene
from tron.seeds import generator
from tron.shading.environments.contrast import HIGH_CONTRAST, INTERVALS, LOW_CONTRAST
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")


def sun_of_share(share: float) -> EnvironmentMap:
    """A small sun before a constant sky of radiance 1: share = (s + 0.01) / (1 + s) of the light."""
    power = 4 * np.pi * (share - 0.01) / (1 - share)
    sun = Disc(np.array([0.0, 0.6, 0.8]), 2.0, np.full(3, power))
    return EnvironmentMap(lay(np.ones((128, 256, 3), np.float32), [sun]))


def test_the_class_follows_from_the_share_of_the_brightest_hundredth():
    for share, expected in (
        *((0.05, "low"), (LOW_CONTRAST - 0.01, "low"), (LOW_CONTRAST + 0.01, "medium")),
        *((HIGH_CONTRAST - 0.01, "medium"), (HIGH_CONTRAST + 0.01, "high"), (0.9, "high")),
    ):
        environment = sun_of_share(share)
        assert contrast_share(environment) == pytest.approx(share, abs=2e-3)
        assert classify(environment) == expected


@pytest.mark.parametrize("wanted", INTERVALS)
def test_lights_of_a_class_are_of_several_families_and_of_it_at_other_resolutions_too(wanted):
    drawn = [draw_light(generator(k, "several", wanted), wanted, EVERY) for k in range(4)]
    assert len({light.family for light in drawn}) >= 2
    for light in drawn[:2]:
        assert classify(light.bake(160)) == wanted


def test_the_nearest_is_taken_where_no_light_is_of_the_class():
    """Suns above a clear plain are all of high contrast."""
    light = draw_light(generator(0, "nearest"), "low", ["sun"])
    shares = [contrast_share(FAMILIES["sun"].draw(generator(k, "suns"), []).bake(64)) for k in range(8)]
    assert light.family == "sun"
    assert contrast_share(light.bake(64)) < np.median(shares)


def hdri(name: str, contrast) -> HdriSpec:
    return HdriSpec(path=name, sha256="", rotation_deg=0.0, contrast=contrast)


def test_the_users_maps_are_drawn_by_their_measured_class():
    files = [hdri("a.exr", "low"), hdri("b.exr", "high"), hdri("c.exr", "low")]
    for k in range(8):
        low = draw_light(generator(k, "files"), "low", ["hdri"], files)
        assert isinstance(low, HdriSpec)
        assert low.path in ("a.exr", "c.exr")
    assert draw_light(generator(0, "files"), "medium", ["hdri"], files).family in EVERY


def test_a_scene_asks_for_classes_and_reads_them_back():
    spec = draw_scene(
        0, "train", 0, style="object", lights=["high", "low", "medium"], frames=1, path_frames=4
    )
    assert [classify(light.bake(64)) for light in spec.lights] == ["high", "low", "medium"]
    assert SceneSpec.model_validate_json(spec.to_json()) == spec


@pytest.mark.long
def test_the_shares_of_the_classes_are_those_that_the_module_tells():
    """A third or so of all drawn lights is of low contrast, about half of high, and some are in between."""
    found = Counter(
        classify(FAMILIES[family].draw(generator(k, "dist", family), []).bake(32))
        for family in EVERY
        for k in range(6)
    )
    total = sum(found.values())
    assert 0.15 < found["low"] / total < 0.45
    assert 0.4 < found["high"] / total < 0.75
    assert found["medium"] / total > 0.04

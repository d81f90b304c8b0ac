"""A capture carries what its prior gives, and nothing that the prior did not give."""

import logging
from functools import partial

import numpy as np
import pytest

from tron.errors import TronError
from tron.reconstruction.priors import FIELDS, GroundTruth, MapPrior, apply_prior
from tron.seeds import generator

HEIGHT, WIDTH = 40, 48  # of plain views

SHAPE = (HEIGHT, WIDTH)


class Given(MapPrior):
    """A prior of whatever the test says."""

    def __init__(self, **maps) -> None:
        self.maps = maps

    def fields(self, capture):
        return dict.fromkeys(self.maps, "given")

    def prepare(self, capture, fields):
        return lambda view: {
            field: value for field, value in self.maps.items() if field != "normal" or view.name != "frame_0"
        }


def test_ground_truth_gives_the_capture_s_own_maps_unread(plain) -> None:
    calls = []

    def read() -> np.ndarray:
        calls.append(1)
        return np.full((*SHAPE, 3), 0.25)

    out = apply_prior(plain(base_color=read, roughness=np.full(SHAPE, 0.5)), GroundTruth())
    assert not calls
    view = out.train_views[0]
    assert [field for field in FIELDS if view.has(field)] == ["base_color", "roughness"]
    np.testing.assert_array_equal(view.read("base_color"), 0.25)


def test_ground_truth_of_photos_is_refused(plain) -> None:
    with pytest.raises(TronError, match="no true maps"):
        apply_prior(plain(), GroundTruth())


def test_what_a_prior_cannot_give_is_none_and_said(caplog: pytest.LogCaptureFixture, plain) -> None:
    capture = plain(metallic=np.zeros(SHAPE), base_color=np.zeros((*SHAPE, 3)))
    with caplog.at_level(logging.INFO):
        out = apply_prior(capture, Given(roughness=np.full(SHAPE, 0.4)))
    for view in out.train_views:
        assert not view.has("base_color")  # the truth does not leak into another prior's maps
        np.testing.assert_allclose(view.read("roughness"), 0.4, atol=1e-3)
    assert out.test_views[0].has("base_color")
    assert "base_color: not available from Given" in caplog.text
    assert "roughness: given" in caplog.text


def test_only_the_fields_asked_for_are_touched(plain) -> None:
    capture = plain(metallic=np.ones(SHAPE), roughness=np.ones(SHAPE))
    view = apply_prior(capture, Given(roughness=np.full(SHAPE, 0.4)), fields=("roughness",)).train_views[0]
    assert view.read("metallic").min() == 1
    assert view.read("roughness").max() < 1
    with pytest.raises(TronError, match="'albedo' is no field"):
        apply_prior(capture, GroundTruth(), fields=("albedo",))


def test_arrays_are_packed_to_within_half_a_percent_and_checked(plain) -> None:
    rng = generator(1, "priors")
    irradiance, sky = rng.uniform(0, 50, (*SHAPE, 3)), rng.uniform(0, 1, SHAPE) > 0.5
    view = apply_prior(plain(), Given(irradiance=irradiance, sky_mask=sky)).train_views[0]
    np.testing.assert_allclose(view.read("irradiance"), irradiance, rtol=1e-3)
    np.testing.assert_array_equal(view.read("sky_mask"), sky)
    with pytest.raises(TronError, match="base_color ranges"):
        apply_prior(plain(), Given(base_color=np.full((*SHAPE, 3), 2.0)))
    with pytest.raises(TronError, match="roughness has shape"):
        apply_prior(plain(), Given(roughness=np.zeros((3, 3))))


def test_views_without_a_map_are_counted(caplog: pytest.LogCaptureFixture, plain) -> None:
    normal = partial(np.broadcast_to, np.array([0.0, 0.0, 1.0]), (*SHAPE, 3))
    out = apply_prior(plain(), Given(normal=normal))
    assert [view.has("normal") for view in out.train_views] == [False, True]
    assert "normal: missing for 1 of 2 views (first: frame_0)" in caplog.text


def test_a_field_that_nobody_would_ask_for_is_refused_before_long_work(plain) -> None:
    with pytest.raises(TronError, match="'roughnes' is no field of a prior"):
        Given(roughnes=np.full(SHAPE, 0.5)).check(plain())


class Misspelt(Given):
    """A prior whose maps have another name than the fields that it offers."""

    def prepare(self, capture, fields):
        return lambda view: {"metalic": self.maps["metallic"]}


def test_a_misspelt_map_is_refused_by_its_view(plain) -> None:
    with pytest.raises(TronError, match=r"'metalic' is no field of a prior \(maps of view frame_\d\)"):
        apply_prior(plain(), Misspelt(metallic=np.zeros(SHAPE)))

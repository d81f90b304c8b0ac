"""A capture carries what its prior gives, and nothing that the prior did not give."""

import logging
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from tron.errors import TronError
from tron.priors import FIELDS, Classical, GroundTruth, apply_prior
from tron.seeds import generator

HEIGHT, WIDTH = 40, 48  # of plain views

SHAPE = (HEIGHT, WIDTH)


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
        out = apply_prior(capture, Classical(roughness=0.4))
    for view in out.train_views:
        assert not view.has("base_color")  # the truth does not leak into another prior's maps
        np.testing.assert_allclose(view.read("roughness"), 0.4, atol=1e-6)
    assert out.test_views[0].has("base_color")
    assert "base_color: not before the geometry is reconstructed" in caplog.text
    assert "roughness: constant 0.4" in caplog.text


def test_only_the_fields_asked_for_are_touched(plain) -> None:
    capture = plain(metallic=np.ones(SHAPE), roughness=np.ones(SHAPE))
    view = apply_prior(capture, Classical(), fields=("roughness",)).train_views[0]
    assert view.read("metallic").min() == 1
    assert view.read("roughness").max() < 1
    with pytest.raises(TronError, match="'albedo' is no field"):
        apply_prior(capture, Classical(), fields=("albedo",))


class Given:
    """A prior of whatever the test says."""

    needs_geometry = frozenset()

    def __init__(self, **maps) -> None:
        self.maps = maps

    def fields(self, capture):
        return dict.fromkeys(self.maps, "given")

    def prepare(self, request):
        return lambda view: {
            field: value for field, value in self.maps.items() if field != "normal" or view.name != "frame_0"
        }


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


def test_priors_load_no_network_before_they_need_one() -> None:
    code = "import sys, tron.priors; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not {"torch", "diffusers", "transformers", "mitsuba", "drjit"} & set(loaded.split())

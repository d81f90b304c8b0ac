"""Measure of what lights save that share a frame: its errors, its lights, and a tiny run of it."""

import json
from pathlib import Path

import numpy as np
import pytest

import datagen.sharing
from datagen.lights import classify
from datagen.settings import Settings
from datagen.sharing import Reference, draw_lights, measure_sharing
from tron.cli.recipes import check, compose_recipe
from tron.seeds import generator
from tron.shading.environment import EnvironmentMap


def test_errors_are_relative_and_on_one_scale():
    """Against the formula by hand: light k is k times as bright and exposed by 1 / k."""
    truth = np.array([1.0, 4.0]).reshape(2, 1, 1, 1) * np.full((2, 3, 5, 3), 0.5)
    reference = Reference([truth, truth], exposures=np.array([1.0, 0.25]))
    image = truth * 1.1
    np.testing.assert_allclose(reference.errors(image), 0.05**2 / (0.25 + 0.01))
    assert reference.bias(image) == pytest.approx(0.1)
    image[1] = truth[1] * 0.8
    assert reference.bias(image) == pytest.approx(-0.2), "that of the worst light: signs do not cancel"


def test_the_noise_of_the_reference_is_taken_off():
    rng = generator(0, "noise")
    truth = np.full((1, 200, 200, 3), 2.0)
    halves = [truth + rng.normal(0, 0.2, truth.shape) for _ in range(2)]
    reference = Reference(halves, exposures=np.ones(1))
    assert reference.errors(truth)[0] == pytest.approx(0.0, abs=1e-4)
    noisy = truth + rng.normal(0, 0.1, truth.shape)
    assert reference.errors(noisy)[0] == pytest.approx(0.1**2 / 4.01, rel=0.1)


def test_half_of_the_lights_are_of_high_contrast_and_half_of_low(variant):
    first, again = draw_lights(5, 16), draw_lights(5, 16)
    kinds = [classify(light) for light in first]
    assert kinds == ["high"] * 10 + ["low"] * 10
    assert {light.image.shape for light in first} == {(16, 32, 3)}
    for a, b in zip(first, again):
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.long
def test_a_tiny_run_finds_that_sharing_pays(variant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    few = [EnvironmentMap(np.abs(generator(k, "few").normal(size=(8, 16, 3))) ** 3) for k in range(4)]
    monkeypatch.setattr(datagen.sharing, "draw_lights", lambda *_: few)
    tiny = ["sharing.scenes=1", "sharing.size=12", "sharing.path_spp=36", "sharing.rounds=2"]
    tiny += ["mesh_edge=0.2", "environment_height=8", "objects=[2,2]", f"output_dir={tmp_path}"]
    measure_sharing(check(compose_recipe("conf.datagen", Settings, [*tiny, "mode=sharing"]), Settings))
    (case,) = json.loads((tmp_path / "sharing.json").read_text())["cases"]
    assert case["lights"] == 4
    assert case["gain"] == pytest.approx(case["seconds"]["alone"] / case["seconds"]["together"])
    assert case["gain"] > 1
    errors = [case["error"][str(n)] for n in (9, 20, 36, 56)]
    assert errors == sorted(errors, reverse=True)
    assert abs(case["bias"]) < 0.02
    assert (tmp_path / "sharing" / f"{case['scene']}.png").is_file()

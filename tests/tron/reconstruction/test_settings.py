"""The defaults are the paper's, wherever they are written; a scaled schedule reaches as far in its steps."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from tron.apps.reconstruct.cli import Settings
from tron.cli.recipes import check, compose_recipe
from tron.reconstruction.settings import (
    DensitySettings,
    FitSettings,
    MaterialSettings,
    RadianceSettings,
    ReconstructionSettings,
)

PATHS = ["capture=in", "output_dir=out"]
STEP_NUMBERS = {
    "steps",
    "sh_every",
    *("density.start", "density.end", "density.every", "density.prune_every", "density.reset_every"),
    "consistency.every",
}
RATES_OF_PLACES = {"position_rate", "position_rate_final", "rotation_rate"}


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


@pytest.fixture(scope="module")
def paper() -> Settings:
    """The recipe experiment=paper of tron-reconstruct."""
    return check(compose_recipe("conf.reconstruct", Settings, ["experiment=paper", *PATHS]), Settings)


def test_the_papers_recipe_is_that_of_the_facts(paper: Settings) -> None:
    """The numbers of the paper, and those of 3DGRT that it inherits."""
    radiance, density, materials = paper.radiance, paper.radiance.density, paper.materials
    assert (radiance.steps, materials.steps, paper.steps_scaler) == (30_000, 7000, 1.0)
    assert (radiance.position_rate, radiance.position_rate_final) == (1.6e-4, 1.6e-6)
    assert (radiance.opacity_rate, radiance.sh_rate, radiance.sh_rest_rate) == (0.05, 2.5e-3, 1.25e-4)
    assert (radiance.rotation_rate, radiance.scale_rate) == (1e-3, 5e-3)
    assert (radiance.sh_degree, radiance.sh_every) == (3, 1000)
    assert (radiance.ssim, materials.ssim, radiance.mask) == (0.2, 0.2, 0.2)
    assert radiance.background == "black"
    assert (density.start, density.end, density.every, density.threshold) == (500, 15_000, 300, 2e-4)
    assert (density.prune_every, density.reset_every) == (100, 3000)
    assert (paper.initial.kernel_degree, paper.initial.count, paper.max_side) == (2, 100_000, None)
    assert paper.light is not None
    assert (paper.light.resolution, paper.light.steps) == (512, 4000)


def test_the_papers_recipe_fits_the_light_with_final_shadows_and_large_batches(paper: Settings) -> None:
    """64 shadow rays are the paper's final quality; it names no batches: they are ours for its size."""
    light, quick = paper.light, FitSettings()
    assert light is not None
    assert (light.rays, light.scale_rays) == (64, 64)
    assert (light.pixels, light.scale_pixels) == (128**2, 512**2)
    sizes = {name for name in FitSettings.model_fields if getattr(light, name) != getattr(quick, name)}
    assert sizes == {"resolution", "steps", "rays", "pixels", "scale_rays", "scale_pixels"}


def test_the_papers_recipe_has_room_for_a_million_surfels(paper: Settings) -> None:
    """Numbers that the paper does not name: 3DGS's initial opacity, a prior's weight, constant rates."""
    assert (paper.initial.opacity, paper.radiance.density.most) == (0.1, 1_000_000)
    assert paper.radiance.normal == 0.1
    assert (paper.materials.rate, paper.materials.decay) == (2.5e-3, 1.0)
    assert paper.variant == "cuda_ad_rgb"


def test_the_defaults_are_the_papers_but_for_what_so_short_a_schedule_needs(paper: Settings) -> None:
    """Each measured: dev/LOG.md."""
    own, its = (
        flat({name: values[name] for name in ("radiance", "materials")})
        for values in (ReconstructionSettings().model_dump(mode="json"), paper.model_dump(mode="json"))
    )
    assert {name for name in its if own[name] != its[name]} == {
        "radiance.normal",
        "radiance.consistency.weight",
        *(f"radiance.density.{name}" for name in ("end", "every", "threshold", "reset_every", "most")),
        "materials.rate",
        "materials.decay",
    }


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0])
def test_scaling_changes_step_numbers_and_the_rates_of_places(factor: float) -> None:
    before, after = (flat(s.model_dump()) for s in (RadianceSettings(), RadianceSettings().scaled(factor)))
    assert before.keys() == after.keys()
    for name, value in before.items():
        if name in RATES_OF_PLACES:
            continue
        assert after[name] == (round(value * factor) if name in STEP_NUMBERS else value), name
    one, other = MaterialSettings(), MaterialSettings().scaled(factor)
    assert other == one.model_copy(update={"steps": round(one.steps * factor)})


@pytest.mark.parametrize("factor", [0.01, 0.1, 2.0])
def test_a_surfel_wanders_as_far_in_a_scaled_schedule(factor: float) -> None:
    """n steps of one length and random direction reach length x sqrt(n); the paper's own schedule stays."""
    before, after = RadianceSettings(), RadianceSettings().scaled(factor)
    for name in RATES_OF_PLACES:
        reach = [getattr(each, name) * each.steps**0.5 for each in (before, after)]
        assert reach[1] == pytest.approx(reach[0], rel=1e-12), name
    assert RadianceSettings().scaled(1.0) == RadianceSettings()


@pytest.mark.parametrize(("place", "moving", "turning"), [("in place", 1, 1), ("near", 10**0.25, 10**0.5)])
def test_surfels_move_faster_the_farther_they_may_have_to_go(place, moving: float, turning: float) -> None:
    before, after = RadianceSettings(), RadianceSettings().scaled(0.1, place)
    for name in RATES_OF_PLACES:
        faster = turning if name == "rotation_rate" else moving
        assert getattr(after, name) == pytest.approx(faster * getattr(before, name)), name
    assert after.steps == RadianceSettings().scaled(0.1).steps


def test_a_scaled_step_number_stays_one_and_one_that_was_off_stays_off() -> None:
    density = DensitySettings(reset_every=0, prune_every=1)
    short = RadianceSettings(steps=0, density=density).scaled(1e-3)
    assert short.density.prune_every == short.density.every == short.sh_every == 1
    assert short.density.reset_every == short.steps == 0


def test_settings_neither_change_nor_take_what_they_do_not_know() -> None:
    with pytest.raises(ValidationError):
        RadianceSettings().steps = 3  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValidationError, match="stepz"):
        RadianceSettings(stepz=3)  # pyright: ignore[reportCallIssue]
    with pytest.raises(ValidationError, match="scale_rate"):
        RadianceSettings(scale_rate=float("nan"))


def test_some_steps_must_see_the_photos_as_they_are() -> None:
    with pytest.raises(ValueError, match="leave no step"):
        RadianceSettings(coarse=(0.6, 0.6))

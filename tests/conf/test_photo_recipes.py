"""Recipes for photos: what each adds to the one beneath it, and that their schedules hold together."""

from __future__ import annotations

from typing import Any, cast

import pytest
from omegaconf import OmegaConf

from tron.apps.reconstruct.settings import Settings
from tron.cli.recipes import check, compose_recipe
from tron.run_folder import leaves

FOX = (1080, 1920)


def composed(*overrides: str) -> Settings:
    given = ["capture=photos", "output_dir=out", *overrides]
    return check(compose_recipe("conf.reconstruct", Settings, given), Settings)


def test_photos_are_a_quarter_of_a_phones_frame_and_no_camera_makes_them_slow() -> None:
    photos = composed("experiment=photos")
    assert photos.of_loading().size_of(*FOX) == (270, 480)
    assert photos.of_loading().size_of(4032, 3024) == (480, 360)
    assert photos.of_loading().size_of(320, 240) == (320, 240)
    assert photos.radiance.density.most >= 100_000
    assert 0 < sum(photos.radiance.coarse) < 1  # the last steps see whole photos
    assert photos.variant == "llvm_ad_rgb"


def test_a_fine_reconstruction_has_300000_surfels_of_photos_at_half_a_phones_frame() -> None:
    fine = composed("experiment=photos_fine")
    assert fine.radiance.density.most == 300_000
    assert fine.of_loading().size_of(*FOX) == (540, 960)
    assert fine.initial.stereo.most_side >= 480
    radiance = fine.radiance.scaled(fine.steps_scaler, "near")
    assert radiance.steps == 6000
    # Room for the surfels: a tenth as many again each time would do from 40,000.
    times = (radiance.density.end - radiance.density.start) / radiance.density.every
    assert fine.initial.count * 1.1**times > fine.radiance.density.most
    assert fine.variant == "llvm_ad_rgb"


def test_the_gpu_has_more_steps_and_larger_photos() -> None:
    fine, gpu = composed("experiment=photos_fine"), composed("experiment=photos_gpu")
    assert gpu.variant == "cuda_ad_rgb"
    assert gpu.steps_scaler > fine.steps_scaler
    assert gpu.radiance.density.most > fine.radiance.density.most
    assert gpu.of_loading().size_of(*FOX) == FOX
    assert gpu.initial.stereo.most_side >= 960


@pytest.mark.parametrize("name", ["photos_fine", "photos_gpu"])
def test_they_are_recipes_for_photos_and_nothing_of_that_is_undone(name: str) -> None:
    def plain(settings: Settings) -> dict[str, Any]:
        return leaves(cast(dict, OmegaConf.to_container(OmegaConf.create(settings.model_dump(mode="json")))))

    base, photos, this = (plain(composed(*o)) for o in ([], ["experiment=photos"], [f"experiment={name}"]))
    chosen = {key for key in photos if photos[key] != base[key]}
    assert {"radiance.sh_degree", "radiance.background", "radiance.coarse"} <= chosen
    grown = {"max_side", "initial.count", "initial.stereo.most_side", "radiance.density.most"}
    assert {key: this[key] for key in chosen - grown} == {key: photos[key] for key in chosen - grown}
    assert all(this[key] > photos[key] for key in grown)
    assert this["prior._target_"] == "tron.reconstruction.Joint"

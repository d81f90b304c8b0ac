"""What frames are made with: every setting, unless its own field says that it is for display only."""

import json

import numpy as np
import pytest
from pydantic import Field

from tron.apps.relight.cli import main
from tron.apps.relight.settings import DisplayOnly, Settings
from tron.errors import TronError

DISPLAY = {
    *("output_dir", "background", "exposure", "look", "checkpoint", "window", "overlap", "reproject"),
    *("weights", "vae", "buffers", "overwrite", "threads"),
}
"""Settings that change no traced frame: pictures are made of the frames anew in each run."""


class Younger(Settings):
    """Settings with two more, as they might come."""

    haze: float = Field(0.0, description="in the light's way")
    caption: DisplayOnly[str] = Field("", description="below the pictures")


@pytest.fixture
def film(scene_path, light_path, tmp_path, variant):
    """Films one frame into one folder with these settings; gives how many frames were traced."""

    def film(**given: object) -> int:
        files = {"scene": scene_path, "environment": light_path, "output_dir": tmp_path / "out"}
        size = {"width": 16, "height": 16, "frames": 1, "bounces": 0, "checkpoint": None, "variant": variant}
        main(Younger.model_validate({**files, **size, **given}))
        return int(json.loads((tmp_path / "out" / "relight.json").read_text())["frames_rendered"])

    return film


def test_a_new_setting_refuses_frames_of_another_value_and_display_only_goes_on(film, tmp_path):
    assert film() == 1
    with pytest.raises(TronError, match=r"made with haze=0\.0, not 0\.5"):
        film(haze=0.5)
    assert film(haze=0.5, overwrite=True) == 1
    assert film(haze=0.5, caption="noon", look="none") == 0, "pictures alone are made anew"
    assert json.loads((tmp_path / "out" / "frames" / "settings.json").read_text())["haze"] == 0.5


def test_every_setting_is_one_of_the_two_and_files_count_by_what_is_in_them(scene_path, light_path, tmp_path):
    files = {"scene": scene_path, "environment": light_path, "output_dir": tmp_path, "cameras": light_path}
    settings = Settings.model_validate(files | {"denoise": "oidn"})
    made = settings.made_with(3, np.array([0, 0, 1]))
    stands = {name.removesuffix("_sha256") for name in made}
    assert set(Settings.model_fields) - stands == DISPLAY
    standing = settings.model_copy(update={"cameras": None}).made_with(3, np.array([0, 0, 1]))
    assert "fps" not in standing, "nothing knows of seconds without a file of cameras or a motion"
    assert made["cameras_sha256"] == made["environment_sha256"] != made["scene_sha256"]
    assert not any(isinstance(value, str) and str(tmp_path.parent) in value for value in made.values())

"""TensoIR's maps mean what its files encode."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.errors import TronError


@pytest.fixture
def scene(tmp_path: Path, photos, write) -> Path:
    write.tensoir(tmp_path, photos)
    width, height = write.size
    albedo = np.full((height, width, 4), 255, np.uint8)
    albedo[..., :3] = (255, 128, 0)
    albedo[:, : width // 2] = 0
    normal = np.full((height, width, 4), 255, np.uint8)
    normal[..., :3] = np.round(255 * (np.array([0.6, 0.0, 0.8]) + 1) / 2)
    normal[:, : width // 2] = (128, 128, 255, 0)
    for folder in tmp_path.iterdir():
        write.save(folder / "albedo.png", albedo)
        write.save(folder / "normal.png", normal)
        write.save(folder / "rgba_city.png", write.picture(15, channels=4))
    return tmp_path


def test_the_split_is_that_of_the_folders(scene: Path) -> None:
    capture = load_capture(scene)
    assert [view.name for view in capture.train_views] == [f"train_{index:03d}" for index in range(7)]
    assert [view.name for view in capture.test_views] == ["test_000", "test_001", "test_002"]
    assert capture.up[2] > 0.99


@pytest.mark.parametrize("downscale", [1, 4])
def test_albedo_is_linear_and_normals_are_the_worlds(scene: Path, downscale: int) -> None:
    view = load_capture(scene, LoadSettings(downscale=downscale)).views[0]
    assert view.space == "display"
    color, normal = view.read("base_color"), view.read("normal")
    assert np.allclose(color[0, -1], (1, (128 / 255) ** 2.2, 0), atol=1e-5)
    assert np.allclose(normal[0, -1], (0.6, 0, 0.8), atol=0.01)
    assert np.allclose(np.linalg.norm(normal[:, -1], axis=-1), 1, atol=1e-5)
    assert not color[0, 0].any()
    assert not normal[0, 0].any()


def test_another_light_can_be_chosen(scene: Path) -> None:
    assert load_capture(scene, LoadSettings(tensoir_light="city")).views[0].read()[..., 2].mean() > 0.9
    with pytest.raises(TronError, match=r"no view has a photo under the light 'night'.*"):
        load_capture(scene, LoadSettings(tensoir_light="night"))
    with pytest.raises(TronError, match="leads out"):
        load_capture(scene, LoadSettings(tensoir_light="../../x"))


def test_a_damaged_map_is_left_out_and_said(scene: Path, caplog: pytest.LogCaptureFixture) -> None:
    (scene / "train_000" / "normal.png").write_bytes(b"\x89PNG\r\n")
    capture = load_capture(scene)
    without = {view.name for view in capture.views if not view.has("normal")}
    assert without == {"train_000"}
    assert "1 maps left out, first normal of train_000" in caplog.text

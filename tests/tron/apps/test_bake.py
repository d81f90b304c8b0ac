"""tron-bake from end to end: a file that an independent splat rasteriser draws as tron lights the scene."""

from pathlib import Path

import numpy as np
import plyfile
import pytest

from eval.applications.splat_rasteriser import rasterise
from tron.apps.bake import cli
from tron.cameras import Camera
from tron.color import to_display
from tron.estimation import Estimation
from tron.framing import upright
from tron.gaussians.edit import KERNEL_WIDTHS
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import GaussianScene
from tron.metrics import psnr
from tron.relighting import Relighter
from tron.shading.environments.environment import EnvironmentMap

REFERENCE_ORDER = [
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
"""Of save_ply in scene/gaussian_model.py of the reference code."""


@pytest.fixture
def folder(tmp_path: Path, ball_on_floor) -> Path:
    ball_on_floor().save(tmp_path / "scene.ply")
    image = np.full((32, 64, 3), 0.3, np.float32)
    image[6:9, 14:18] = 40.0
    EnvironmentMap(image).save(tmp_path / "sun.exr")
    return tmp_path


def bake(folder: Path, *arguments: str) -> int:
    words = [f"scene={folder}/scene.ply", f"environment={folder}/sun.exr", f"output={folder}/relit.ply"]
    with pytest.raises(SystemExit) as stop:
        cli([*words, *arguments])
    return int(stop.value.code or 0)


@pytest.mark.usefixtures("variant")
def test_a_splat_rasteriser_draws_the_relit_scene(folder, caplog):
    """At a view that no fit saw; without the wider kernel it is worse."""
    with caplog.at_level("INFO"):
        assert bake(folder, "exposure=1", "look=none") == 0
    assert "reflections are blurred" in caplog.text
    scene = GaussianScene.load(folder / "scene.ply")
    light = Relighter(scene, Estimation(rays=64)).under(EnvironmentMap.load(folder / "sun.exr"))
    camera = Camera.look_at((-1.5, -2.4, 1.4), (0, 0, 0.3), fov_deg=40, width=192, height=192)
    frame = light.render(camera, background=(0, 0, 0))
    solid = frame.mask > 0.995
    truth = to_display(frame.lit, 1.0)[solid]
    found = psnr(rasterise(folder / "relit.ply", camera)[0][solid], truth)
    assert found > 28, found
    narrow = GaussianScene.load(folder / "relit.ply")
    narrow.log_scales -= np.float32(np.log(KERNEL_WIDTHS))
    narrow.save(folder / "narrow.ply")
    assert psnr(rasterise(folder / "narrow.ply", camera)[0][solid], truth) < found


@pytest.mark.usefixtures("variant")
def test_the_file_is_plain_and_ours_reads_it(folder):
    """Properties of 3DGS alone; places, opacities and orientations are the scene's."""
    assert bake(folder) == 0
    written = plyfile.PlyData.read(str(folder / "relit.ply"))["vertex"]
    assert [each.name for each in written.properties] == REFERENCE_ORDER
    scene, relit = (GaussianScene.load(folder / name) for name in ("scene.ply", "relit.ply"))
    assert (relit.kernel_degree, relit.materials_guessed, relit.oriented) == (2, True, True)
    assert relit.spacing == scene.spacing
    for name in ("means", "quats", "opacity_logits"):
        np.testing.assert_array_equal(getattr(relit, name), getattr(scene, name))
    np.testing.assert_allclose(relit.scales(), KERNEL_WIDTHS * scene.scales(), rtol=1e-5)
    assert np.exp(written["scale_2"]).max() < 0.01 * relit.scales().min()


@pytest.mark.usefixtures("variant")
def test_the_file_stands_in_the_scenes_own_frame(folder):
    """A scene with +x up, and the same with +z: one light, one radiance, turned."""
    assert bake(folder, "exposure=1") == 0
    standing = GaussianScene.load(folder / "relit.ply")
    turn = upright(np.array([1.0, 0, 0])).T
    GaussianScene.load(folder / "scene.ply").rotated(turn).save(folder / "scene.ply")
    assert bake(folder, "exposure=1") == 0
    scene, lying = (GaussianScene.load(folder / name) for name in ("scene.ply", "relit.ply"))
    np.testing.assert_allclose(lying.means, scene.means, atol=1e-5)
    np.testing.assert_allclose(lying.up, [1, 0, 0], atol=1e-6)
    along = np.array([0.3, 0.5, -0.81])
    difference = eval_sh(lying.sh, turn @ along) - eval_sh(standing.sh, along)
    assert np.abs(difference).mean() < 0.01  # noise of other rays


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["environment=absent.hdr"], "absent.hdr"),
        (["up=[0,0,0]"], "a direction has a length"),
        (["exposure=0"], "exposure"),
        (["rotations=3"], "did you mean 'rotation'"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_the_last_output_as_it_was(folder, capsys, arguments, said):
    (folder / "relit.ply").write_text("of the last run")
    assert bake(folder, *arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tron-bake: ")]
    assert len(errors) == 1
    assert said in errors[0]
    assert (folder / "relit.ply").read_text() == "of the last run"

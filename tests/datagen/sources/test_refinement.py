"""Surfels fitted to true G-buffers of a board with sharp squares, whose pixels have a closed form."""

import numpy as np
import pytest

from datagen.dataset.spool import ViewSpool
from datagen.sources import refinement
from datagen.sources.refinement import WINDOW, refine_surfels
from tron.cameras import Camera
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.reconstruction.geometry import training

SIDE = 224  # larger than a window
SQUARE = 0.22
SEED = 5


def board(camera: Camera) -> GBufferView:
    """Squares of two colours on [-1, 1]^2 at z = 0, one object on each side of x = 0."""
    rays = camera.exact_rays()
    position = camera.position - rays * (camera.position[2] / rays[..., 2:])
    valid = (np.abs(position[..., :2]) < 1).all(-1)
    odd = np.floor(position[..., :2] / SQUARE).sum(-1) % 2 == 1
    return GBufferView(
        camera=camera,
        position=position,
        normal=np.broadcast_to([0.0, 0, 1], position.shape),
        base_color=np.where(odd[..., None], [0.8, 0.2, 0.1], [0.1, 0.3, 0.7]),
        roughness=np.where(odd, 0.3, 0.7),
        metallic=np.zeros(odd.shape),
        rgb=None,
        valid=valid,
        object_id=np.where(position[..., 0] > 0, 2, 1),
    )


def cameras(count: int, turn: float) -> list[Camera]:
    angles = turn + 2 * np.pi * np.arange(count) / count
    size = {"fov_deg": 50, "width": SIDE, "height": SIDE}
    return [Camera.look_at((1.2 * np.cos(a), 1.2 * np.sin(a), 2.5), (0, 0, 0), **size) for a in angles]


@pytest.fixture
def one_thread(variant: str) -> None:
    """Sums in a fixed order; the fixture drjit_threads gives the threads back."""
    if variant.startswith("cuda"):
        pytest.skip("a GPU adds in no fixed order: nothing repeats there bit by bit")
    import drjit as dr

    dr.set_thread_count(1)


@pytest.fixture
def spooled(variant: str, tmp_path):
    """Surfels of six views; those views and two others as the fit reads them."""
    with ViewSpool(tmp_path / "seen") as seen, ViewSpool(tmp_path / "others") as others:
        surfels = surfels_from_gbuffers(seen.passing(map(board, cameras(6, 0.0))), count=1500)
        for _ in others.passing(map(board, cameras(2, 0.4))):
            pass
        yield surfels, seen.views(), others.views()


def test_the_fit_sharpens_what_other_cameras_see_and_keeps_what_surfels_lie_on(spooled, one_thread) -> None:
    surfels, seen, others = spooled
    fitted, found = refine_surfels(surfels, seen, others, 60, SEED)
    assert min(view.camera.width for view in seen) > WINDOW
    assert found.steps == 60
    assert found.after.base_color_psnr > found.before.base_color_psnr + 1.5
    assert found.after.silhouette_error < 0.7 * found.before.silhouette_error
    np.testing.assert_array_equal(fitted.object_id, surfels.object_id)
    assert fitted.spacing == surfels.spacing
    # They stay on their side but for those at the border.
    beyond = np.where(fitted.object_id == 1, fitted.means[:, 0], -fitted.means[:, 0])
    assert beyond.max() < 2 * surfels.spacing


def test_a_fit_repeats_bit_by_bit(spooled, one_thread) -> None:
    surfels, seen, others = spooled
    first, again = (refine_surfels(surfels, seen, others, 5, SEED)[0] for _ in range(2))
    another = refine_surfels(surfels, seen, others, 5, SEED + 1)[0]
    assert first.means.tobytes() == again.means.tobytes()
    assert first.base_color.tobytes() == again.base_color.tobytes()
    assert first.means.tobytes() != another.means.tobytes()


@pytest.mark.long
def test_windows_gain_more_than_whole_views_of_as_many_pixels(spooled, one_thread, monkeypatch) -> None:
    surfels, seen, others = spooled
    after, pixels, whole = [], [], training.render

    def counted(tensors, camera: Camera, **more):
        pixels[-1] += camera.width * camera.height
        return whole(tensors, camera, **more)

    monkeypatch.setattr(training, "render", counted)
    for side, steps in ((SIDE // 4, 240), (SIDE, 15)):
        monkeypatch.setattr(refinement, "WINDOW", side)
        pixels.append(0)
        after.append(refine_surfels(surfels, seen, others, steps, SEED)[1].after.base_color_psnr)
    assert pixels[0] == pixels[1] == 15 * SIDE**2
    # 1.0 to 1.4 of three orders of views; the vector width moves either by 0.1.
    assert after[0] > after[1] + 0.5

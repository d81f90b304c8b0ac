"""Photos without poses get those that a transforms.json has for them, but for where the world is."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.captures import LoadSettings, load_capture
from tron.captures.photos.photo_files import inspect_photo

COUNT = 12


@pytest.fixture(scope="module")
def fox(shared_data: Path) -> Path:
    path = shared_data / "captures" / "fox"
    if not path.is_dir():
        pytest.skip(f"no real capture: {path} is absent")
    return path


def aligned(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) moved, turned and scaled onto target (N, 3), and the rotation (Umeyama 1991)."""
    x, y = points - points.mean(0), target - target.mean(0)
    u, scales, vt = np.linalg.svd(y.T @ x / len(x))
    signs = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u * signs @ vt
    scale = (scales * signs).sum() / (x**2).sum(1).mean()
    return scale * x @ rotation.T + target.mean(0), rotation


@pytest.mark.long
def test_the_fox_is_posed_as_its_file_says(
    fox: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    truth = load_capture(fox, LoadSettings(downscale=8))
    folder = tmp_path / "photos"
    folder.mkdir()
    for index, path in enumerate(sorted((fox / "images").iterdir())[:COUNT]):
        if index != 5:
            shutil.copy(path, folder)
            continue
        with Image.open(path) as picture:  # stored on its side, as phones do, with a tag that says so
            exif = Image.Exif()
            exif[0x0112] = 6
            picture.transpose(Image.Transpose.ROTATE_90).save(folder / path.name, quality=95, exif=exif)
    settings = LoadSettings(downscale=8, feature_side=800, threads=1)
    capture = load_capture(folder, settings)
    assert len(capture.views) >= COUNT - 1

    by_name = {view.name: view for view in truth.views}
    pairs = [(view, by_name[view.name]) for view in capture.views]
    assert {(view.camera.width, view.camera.height) for view, _ in pairs} == {(135, 240)}
    theirs = np.stack([other.camera.position for _, other in pairs])
    ours, rotation = aligned(np.stack([view.camera.position for view, _ in pairs]), theirs)
    extent = np.linalg.norm(theirs - theirs.mean(0), axis=1).max()
    assert np.linalg.norm(ours - theirs, axis=1).max() < 0.03 * extent
    turned = [rotation @ view.camera.forward @ other.camera.forward for view, other in pairs]
    assert np.degrees(np.arccos(np.clip(min(turned), -1, 1))) < 3
    assert capture.views[0].camera.fx == pytest.approx(truth.views[0].camera.fx, rel=0.05)
    for view, other in pairs:  # the photos are upright too
        assert np.abs(view.read() - other.read()).mean() < 0.06
    assert capture.points is not None
    assert len(capture.points) > 300

    # What was posed is kept: a second load neither repeats it nor differs.
    from tron.captures.posing.structure_from_motion import pose_photos

    caplog.clear()
    with caplog.at_level("INFO", "tron.captures.posing"):
        posed = pose_photos(folder, settings)
    assert [each.getMessage() for each in caplog.records] == [
        f"poses of {COUNT} photos taken from {folder / 'structure_from_motion'}"
    ]
    assert posed.points is not None
    assert np.array_equal(posed.points.astype(np.float32), capture.points)


def test_cameras_that_differ_do_not_share_intrinsics(tmp_path: Path) -> None:
    from tron.captures.posing.structure_from_motion import _copy

    paths = []
    for index, (size, model) in enumerate(
        [((64, 48), "A"), ((64, 48), "A"), ((64, 48), "B"), ((48, 64), "A")]
    ):
        exif = Image.Exif()
        exif[0x0110] = model
        paths.append(tmp_path / f"{index}.jpg")
        Image.new("RGB", size).save(paths[-1], exif=exif)
    copies = _copy({path: inspect_photo(path) for path in paths}, tmp_path / "copies", 32)
    groups = [name.split("/")[0] for name in copies]
    assert groups[0] == groups[1]
    assert len(set(groups)) == 3
    for name in copies:
        with Image.open(tmp_path / "copies" / name) as copy:
            assert max(copy.size) == 32


def test_sixteen_bit_grey_is_scaled_to_eight(tmp_path: Path, write) -> None:
    from tron.captures.posing.structure_from_motion import _copy

    write.save(tmp_path / "a.png", np.full((40, 40), 32768, np.uint16))
    (name,) = _copy({tmp_path / "a.png": inspect_photo(tmp_path / "a.png")}, tmp_path / "copies", 64)
    with Image.open(tmp_path / "copies" / name) as copy:
        assert np.abs(np.asarray(copy, float) - 128).max() <= 1

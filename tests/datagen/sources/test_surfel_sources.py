"""What scenes' surfels are made from: by share, as record and metadata say, and after an interruption."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.dataset.records import WORK, read_record, scene_folder
from datagen.files.sources import ready_sources
from datagen.run.dataset import make
from datagen.run.plan import plan
from datagen.settings.split import SurfelSources
from datagen.sources import reconstructed, synthetic
from datagen.sources.reconstructed import at_true_scale
from datagen.truth.build import draw_and_build
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.shards.reader import read_clips
from tron.tracing import SurfelTracer

REBUILT = [
    *("train.scenes=1", "train_b.scenes=0", "test.scenes=0", "train.lights=[sun,overcast]", "views=6"),
    *("surfels_from=reconstruction", "surfel_reconstruction.steps_scaler=0.002", "surfels=400"),
    *("surfel_reconstruction.checkpoint_every=2", "surfel_reconstruction.path_spp=4"),
]


def test_scenes_are_shared_out_by_seed_split_and_index():
    sources = SurfelSources(gbuffers=3, reconstruction=1)
    drawn = [sources.of(5, "train", k) for k in range(400)]
    assert drawn.count("reconstruction") == pytest.approx(100, abs=30)
    assert drawn == [sources.of(5, "train", k) for k in range(400)]
    assert drawn != [sources.of(5, "train_b", k) for k in range(400)]
    assert {SurfelSources().of(5, "train", k) for k in range(50)} == {"gbuffers"}


def test_one_name_or_shares_are_given(tmp_path, small_settings):
    for words, of in (
        ("surfels_from=reconstruction", (0, 1)),
        ("surfels_from=gbuffers", (1, 0)),
        ("surfels_from={gbuffers: 3, reconstruction: 1}", (3, 1)),
        ("surfels_from.reconstruction=2", (1, 2)),
    ):
        found = small_settings(tmp_path, words).surfels_from
        assert (found.gbuffers, found.reconstruction) == of
    with pytest.raises(TronError, match="one share must be above 0"):
        small_settings(tmp_path, "surfels_from.gbuffers=0")
    with pytest.raises(TronError, match="surfels_from"):
        small_settings(tmp_path, "surfels_from=photographs")


@pytest.mark.long
def test_a_killed_reconstruction_goes_on_and_ends_with_the_same_bytes(
    variant, tmp_path, small_settings, files_of, monkeypatch
):
    whole, cut = (small_settings(tmp_path / name, *REBUILT) for name in ("whole", "cut"))
    assert make(whole) == 0
    record = read_record(whole.output_dir, "train-000000")
    assert record is not None
    assert record.reconstruction is not None
    assert record.reconstruction.albedo_scale is None, "true light leaves no factor open"
    assert record.refinement is None
    assert {clip.meta.extra["surfels_from"] for clip in read_clips(whole.output_dir, "train")} == {
        "reconstruction"
    }
    assert "reconstructed from path-traced" in (whole.output_dir / "README.md").read_text()
    folder = scene_folder(cut.output_dir, plan(cut)[0].name)
    assert not (scene_folder(whole.output_dir, "train-000000") / WORK).exists()

    reconstruct = reconstructed.reconstruct

    def killed(*given, **options):
        def watch(progress, _stage):
            if progress.stage == "radiance" and progress.step == 5:
                raise KeyboardInterrupt

        return reconstruct(*given, **options, watch=watch)

    monkeypatch.setattr(reconstructed, "reconstruct", killed)
    with pytest.raises(KeyboardInterrupt):
        make(cut)
    assert (folder / WORK / "checkpoint.safetensors").is_file()
    monkeypatch.setattr(reconstructed, "reconstruct", reconstruct)
    pictures = folder / WORK / "pictures"
    before = {path: path.stat().st_mtime_ns for path in pictures.rglob("*")}
    forgotten = []

    def forget(scene):
        forgotten.append({path: path.stat().st_mtime_ns for path in pictures.rglob("*")})
        shutil.rmtree(scene / WORK)

    monkeypatch.setattr(synthetic, "clear_work", forget)
    assert make(cut) == 0
    assert forgotten == [before], "pictures are not taken again"
    assert files_of(cut.output_dir) == files_of(whole.output_dir)


@pytest.mark.long
def test_base_color_of_a_joint_fit_has_the_scale_of_the_truth(variant, tmp_path, small_settings, monkeypatch):
    settings = small_settings(tmp_path, *REBUILT, "surfel_reconstruction.prior=joint")
    found = []
    scaled = reconstructed.at_true_scale

    def watched(surfels, truth):
        scene, factors = scaled(surfels, truth)
        again = reconstructed._base_colors(*drawn, settings)
        found.append((factors, scaled(scene, again)[1]))
        return scene, factors

    item = plan(settings)[0]
    drawn = draw_and_build(item, settings, ready_sources(settings), settings.train.lights)
    monkeypatch.setattr(reconstructed, "at_true_scale", watched)
    assert make(settings) == 0
    ((first, second),) = found
    assert np.abs(np.log(first)).max() > 0.02, "the fit was at the truth's scale by itself"
    np.testing.assert_allclose(second, 1, atol=0.03)
    record = read_record(settings.output_dir, "train-000000")
    assert record is not None
    assert record.reconstruction is not None
    np.testing.assert_allclose(record.reconstruction.albedo_scale, first)


FACTORS = np.array([0.5, 0.8, 1.25])


@pytest.fixture(scope="module")
def surfels(small_dataset: Path) -> GaussianScene:
    return GaussianScene.load(small_dataset / "scenes/train-000000/surfels.ply")


@pytest.fixture(scope="module")
def camera(small_dataset: Path) -> Camera:
    clip = next(clip for clip in read_clips(small_dataset, "train") if clip.meta.scene == "train-000000")
    return Camera.from_dict(clip.meta.cameras[0])


def test_factors_are_those_that_the_surfels_are_off_by(surfels: GaussianScene, camera: Camera):
    true = replace(surfels, base_color=np.clip(surfels.base_color, 0.1, 0.7))
    off = replace(true, base_color=(true.base_color / FACTORS).astype(np.float32))
    buffers = SurfelTracer(true).gbuffer(camera).numpy()
    sure = buffers["opacity"] > 0.99
    half = (buffers["opacity"] > 0.02) & ~sure
    rows, columns = np.nonzero(sure)
    mask = half.copy()
    mask[rows[: half.sum() // 2], columns[: half.sum() // 2]] = True  # so that medians tell the two apart
    assert min(half.sum() // 2, len(rows)) > 10
    # What is half covered, or outside the mask, decides nothing.
    elsewhere = np.where(sure[..., None], buffers["base_color"], 9.0)
    scaled, factors = at_true_scale(off, [(camera, elsewhere, mask)])
    np.testing.assert_allclose(factors, FACTORS, rtol=1e-3)
    np.testing.assert_allclose(scaled.base_color, true.base_color, rtol=2e-3)


def test_base_color_stays_a_reflectance(surfels: GaussianScene, camera: Camera):
    mask = np.ones((camera.height, camera.width), bool)
    scaled, factors = at_true_scale(surfels, [(camera, np.full((*mask.shape, 3), 50.0), mask)])
    assert (factors > 10).all()
    assert scaled.base_color.max() == 1


def test_without_a_common_pixel_nothing_changes_and_is_said(
    surfels: GaussianScene, camera: Camera, caplog: pytest.LogCaptureFixture
):
    nothing = np.zeros((camera.height, camera.width))
    scaled, factors = at_true_scale(surfels, [(camera, np.ones((*nothing.shape, 3)), nothing)])
    assert scaled is surfels
    np.testing.assert_array_equal(factors, 1)
    assert "base color is left as it is" in caplog.text

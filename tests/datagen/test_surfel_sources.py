"""What scenes' surfels are made from: by share, as record and metadata say, and after an interruption."""

import shutil

import numpy as np
import pytest

from datagen import reconstructed, run
from datagen.drawn_scene import draw_and_build
from datagen.plan import plan, read_record, scene_folder
from datagen.ready_sources import ready_sources
from datagen.run import make
from datagen.surfel_settings import SurfelSources
from tron.errors import TronError
from tron.shards.reader import read_clips

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
    assert not (scene_folder(whole.output_dir, "train-000000") / reconstructed.FOLDER).exists()

    reconstruct = reconstructed.reconstruct

    def killed(*given, **options):
        def watch(progress, _stage):
            if progress.stage == "radiance" and progress.step == 5:
                raise KeyboardInterrupt

        return reconstruct(*given, **options, watch=watch)

    monkeypatch.setattr(reconstructed, "reconstruct", killed)
    with pytest.raises(KeyboardInterrupt):
        make(cut)
    assert (folder / reconstructed.FOLDER / "checkpoint.safetensors").is_file()
    monkeypatch.setattr(reconstructed, "reconstruct", reconstruct)
    pictures = folder / reconstructed.FOLDER / "pictures"
    before = {path: path.stat().st_mtime_ns for path in pictures.rglob("*")}
    forgotten = []

    def forget(scene):
        forgotten.append({path: path.stat().st_mtime_ns for path in pictures.rglob("*")})
        shutil.rmtree(scene / reconstructed.FOLDER)

    monkeypatch.setattr(run, "forget_reconstruction", forget)
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

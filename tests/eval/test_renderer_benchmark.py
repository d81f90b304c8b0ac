"""The benchmark `renderer` end to end at toy sizes, and what it says to bad input."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from eval.cli import cli
from eval.results import Results
from tron.io.images import read_image

QUALITIES = ("preview", "final")
TINY = [
    *("train_b.scenes=0", "validation.scenes=0", "train.scenes=0", "test.scenes=2", "test.style=table"),
    *("test.lights=[sun]", "test.frames=5", "test.moving_objects=1", "test.still_camera=true"),
    *("test.width=32", "test.height=32", "test.path_spp=16", "test.guidance_spp=2"),
    *("views=4", "view_width=32", "view_height=32", "surfels=1500", "refine_steps=0", "mesh_edge=0.2"),
    *("test.reference_spp=4", "environment_height=32", "workers=1"),
]
"""Clips in which an object moves before a still camera."""


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=renderer", *arguments])
    return end.value.code  # type: ignore[return-value]


def listed(values: list[str]) -> str:
    return json.dumps(values).replace(", ", ",")


def checkpoints(weights: Path) -> list[str]:
    pair, lit = weights / "tiny_of_two.safetensors", weights / "tiny.safetensors"
    return [f"renderer=[{pair},{lit}]"]


def test_untrained_networks_gain_nothing_over_the_buffer_that_they_start_from(
    dataset: Path, weights: Path, tmp_path: Path
):
    """They return pbr and lit: gains over these are zero."""
    data = f"benchmark.data={{synthetic_128: {dataset},synthetic_256: {dataset}}}"
    code = run(
        f"output_dir={tmp_path}",
        "benchmark.parts=[synthetic]",
        data,
        *checkpoints(weights),
        *("benchmark.pixel_mlp=null", "benchmark.pictures=2"),
    )
    assert code == 0
    results = Results.load(tmp_path / "results.json")
    assert results.value("renderer.gain_over_pbr_db") == pytest.approx(0, abs=1e-3)
    assert results.value("renderer.lit.gain_over_lit_db") == pytest.approx(0, abs=1e-3)
    assert results.value("renderer.lit.worst_family_gain_db") == pytest.approx(0, abs=1e-3)
    row = results.find("renderer.gain_db")
    assert row is not None
    assert row.value < 0
    assert row.scenes == 2
    assert row.reference == "target: at least 2 dB"
    for end in ("_full", "_full.256", ".256.sun", ".studio"):
        assert results.find(f"renderer.lit.gain_db{end}") is not None
    page = (tmp_path / "report.html").read_text()
    for section in ("families", "synthetic"):
        assert f'<section id="{section}">' in page
    strips = sorted((tmp_path / "pictures").glob("renderer-synthetic-256-*.png"))
    assert len(strips) == 2
    assert read_image(strips[0]).shape == (256 + 4 + 256, 7 * 256, 3)


@pytest.mark.long
def test_models_and_captures_are_judged_on_their_own_splits(
    dataset: Path, weights: Path, write_dataset: Callable[..., Path], tmp_path: Path
):
    """Untrained networks: gains over what they start from are zero."""
    captures = write_dataset(tmp_path / "captures", frames=1, scenes=3, judged="test_relit")
    names = [f"models_{size}_{quality}" for size in ("128", "256", "512", "512_few") for quality in QUALITIES]
    again = write_dataset(tmp_path / "again", noise=0.02)
    of = dict.fromkeys(names, dataset) | {"models_512_final": again}
    made = ",".join(f"{name}: {folder}" for name, folder in of.items())
    code = run(
        f"output_dir={tmp_path / 'out'}",
        "benchmark.parts=[models,captures]",
        f"benchmark.data={{{made},captures: {captures}}}",
        *checkpoints(weights),
        *("benchmark.pixel_mlp=null", "benchmark.pictures=1"),
    )
    assert code == 0
    results = Results.load(tmp_path / "out" / "results.json")
    zeros = ["capture_gain_over_pbr_db", "preview_gain_db.512", "lit.everywhere.worst_scene_over_input_db"]
    for prefix, size in (("ood", 128), ("final", 256), ("few_ood", 512), ("few_final", 512)):
        zeros += [f"{prefix}_gain_over_pbr_db.{size}", f"lit.{prefix}_gain_over_lit_db.{size}"]
    for name in zeros:
        assert results.value(f"renderer.{name}") == pytest.approx(0, abs=1e-3)
    row = results.find("renderer.lit.capture_gain_over_lit_db")
    assert row is not None
    assert (row.n, row.scenes) == (9, 3)
    gain = results.find("renderer.lit.capture_gain_db")
    assert gain is not None
    assert gain.without_one is not None
    assert results.value("renderer.lit.capture_gain_leave_one_out_db") == gain.without_one[0]
    assert results.value("renderer.lit.everywhere.gain_kept") == 0, "there is no gain"
    for name in ("ood_ssim.lit_filtered.128", "final_seconds.neural_lit.256", "lit.few_final_ssim_gain.512"):
        assert results.find(f"renderer.{name}") is not None
    assert results.find("renderer.ood_psnr.truth.128") is None, "two data sets that are one hold one truth"
    assert results.find("renderer.ood_sharpness.lit.128") is None, "so its noise is not known"
    lit = results.value("renderer.ood_sharpness.lit.512")
    assert lit is not None
    assert 0.5 < lit < 1, "a little less contrast than the truth's"
    assert results.value("renderer.ood_sharpness.neural_lit.512") == pytest.approx(lit, rel=1e-3)
    assert results.value("renderer.identity_psnr") == 100, "an untrained network lets pass what it is given"
    assert results.value("renderer.lit.few_final_gain_over_lit_db_rest.512") == pytest.approx(0, abs=1e-3)
    page = (tmp_path / "out" / "report.html").read_text()
    for section in ("models", "captures"):
        assert f'<section id="{section}">' in page


@pytest.mark.long
def test_clips_and_shadows_from_seeds(weights: Path, tmp_path: Path):
    """The data are made by tron-datagen, once; an untrained network reacts to shadows as lit does."""
    arguments = [
        f"output_dir={tmp_path}",
        "benchmark.parts=[clips,shadows]",
        f"benchmark.synthetic={{128: {listed(TINY)}}}",
        f"benchmark.shadows={listed(TINY)}",
        *checkpoints(weights),
    ]
    assert run(*arguments) == 0
    results = Results.load(tmp_path / "results.json")
    ratio = results.value("renderer.warp_error_ratio")
    assert ratio is not None
    assert ratio < 0.9
    averaged = results.value("renderer.warp_rms.lit_buffer_averaged")
    assert results.value("renderer.warp_rms.lit.averaged") == pytest.approx(averaged, rel=1e-3)
    assert results.value("renderer.lit.clip_gain_over_lit_db") == pytest.approx(0, abs=1e-3)
    assert len(list((tmp_path / "pictures").glob("renderer-clips-*.mp4"))) == 4
    assert results.value("renderer.lit.shadow_correlation") == pytest.approx(
        results.value("renderer.lit_buffer.shadow_correlation"), abs=1e-3
    )
    made = (tmp_path / "synthetic_128" / "manifest.json").stat().st_mtime_ns
    assert run(*arguments) == 0
    assert (tmp_path / "synthetic_128" / "manifest.json").stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["renderer=nowhere.safetensors"], "weights not found"),
        (["renderer=[paper,paper]"], "two weights of neural"),
        (["benchmark.data={synthetic_128: nowhere}"], "no data set synthetic_128"),
        (["benchmark.data={synthetic: .}"], "no data set is called 'synthetic'"),
        (["benchmark.parts=[synthetics]"], "parts"),
    ],
)
def test_bad_input_is_refused_in_a_line_before_anything_is_made(
    arguments: list[str],
    words: str,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "out"
    assert run(f"output_dir={out}", *checkpoints(weights), *arguments) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_a_pickle_is_no_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "evil.safetensors"
    path.write_bytes(b"\x80\x04cos\nsystem\n(S'touch /tmp/owned'\ntR.")
    given = ["benchmark.parts=[synthetic]", f"renderer={path}"]
    assert run(f"output_dir={tmp_path / 'out'}", *given) == 2
    assert str(path) in capsys.readouterr().err

"""The benchmark `ablations` end to end at toy sizes: one choice reached by several ways is one figure."""

import json
from pathlib import Path

import pytest

from eval.cli import cli
from eval.results import Results

TOY = {
    "width": 16, "worlds": 2, "path_spp": 16, "usual": 500, "seeds": 2, "threads": 1,
    "rays": "[2,64]", "surfels": "[120,500]",
}  # fmt: skip


def run(*arguments: str, **changed: object) -> int:
    given = [f"benchmark.{name}={value}" for name, value in (TOY | changed).items()]
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=ablations", *given, *arguments])
    return end.value.code  # type: ignore[return-value]


@pytest.mark.long
def test_one_choice_varies_and_the_others_stay(weights: Path, tmp_path: Path):
    pair, lit = weights / "tiny_of_two.safetensors", weights / "tiny.safetensors"
    parts = "[rays,surfels,bounces,supersampling,seeds,network,weights]"
    out = tmp_path / "out"
    assert run(f"renderer=[{pair},{lit}]", f"output_dir={out}", parts=parts) == 0
    found = Results.load(out / "results.json")
    usual = found.value("rays.psnr.64")
    same = ("surfels.psnr.500", "bounces.psnr.4", "supersampling.psnr.1", "seeds.psnr.0")
    assert [found.value(name) for name in same] == [usual] * 4
    for other in (
        "rays.psnr.2",
        "surfels.psnr.120",
        "bounces.psnr.0",
        "supersampling.psnr.4",
        "seeds.psnr.1",
    ):
        assert found.value(other) != usual
    assert (found.value("surfels.psnr.120") or 99) < (usual or 0), "few surfels are worse"
    assert found.value("weights.psnr.50_50") == pytest.approx(found.value("network.psnr.neural"), abs=1e-3)
    assert len([row for row in found.rows if row.metric.startswith("weights.psnr.")]) == 25
    row = found.find("rays.psnr.64")
    assert row is not None
    assert row.scenes == 2
    page = (out / "report.html").read_text()
    for part in parts.strip("[]").split(","):
        assert f'<section id="{part}">' in page
        assert (out / "pictures" / f"ablations-{part}.png").is_file()
    assert '<section id="fusion">' not in page


@pytest.mark.long
def test_sources_and_fusions_by_their_commands(tmp_path: Path):
    side = ["train.width=32", "train.height=32", "test.width=32", "test.height=32"]
    sizes = ["views=8", "width=32", "height=32", "path_spp=4", "relight_spp=4", "relights=[sun]", "scenes=1"]
    captures = ["experiment=captures", "seed=4100", "mesh_edge=0.2", *(f"capture.{size}" for size in sizes)]
    data = ["experiment=demo", "train.scenes=1", "train_b.scenes=0", "validation.scenes=0", "test.scenes=1"]
    data += [*side, "surfels=500", "refine_steps=0", "mesh_edge=0.2", "environment_height=32", "workers=1"]
    data += ["train.path_spp=4", "test.path_spp=4", "train.guidance_spp=2"]
    steps = ["initial.count=400", "steps_scaler=0.002", "light=null", "report=null"]
    learn = ["experiment=demo", "renderer=tiny", "renderer.config.guidance=[pbr,irradiance]", "max_seconds=4"]
    learn += ["stages=[{name: synthetic, split: train, steps: 1900, crop: 24}]"]
    out = tmp_path / "out"
    given = {"captures": captures, "reconstruct": steps, "dataset": data, "train": learn}
    lists = {key: json.dumps(value) for key, value in given.items()}
    code = run(f"output_dir={out}", parts="[sources,fusion]", **lists)
    assert code == 0
    found = Results.load(out / "results.json")
    for name in ("gbuffers", "joint", "ground_truth"):
        assert (found.value(f"sources.psnr.{name}") or 0) > 5
    assert (found.value("sources.psnr.gbuffers") or 0) > (found.value("sources.psnr.joint") or 99)
    assert {"fusion.psnr.concat", "fusion.psnr.average"} <= {row.metric for row in found.rows}


def test_weights_that_are_not_there_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert run("renderer=nothing.safetensors", f"output_dir={out}", parts="[network]") == 2
    assert "weights not found" in capsys.readouterr().err
    assert not out.exists()

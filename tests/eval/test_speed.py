"""The benchmark `speed` end to end at toy sizes, and what an edit redoes."""

import json
from pathlib import Path

import numpy as np
import pytest

from eval.applications.worlds import draw_world
from eval.cli import cli
from eval.results import Results
from eval.speed import PAPER, Lights, Way, _lit, orbit
from tron.estimation import FINAL
from tron.relighting import Relighter

SURFELS = 600


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=speed", *arguments])
    return end.value.code  # type: ignore[return-value]


@pytest.mark.long
def test_every_way_is_timed_at_every_size_and_after_every_edit(weights: Path, tmp_path: Path):
    pair, lit = weights / "tiny_of_two.safetensors", weights / "tiny.safetensors"
    toy = ["sizes=[16]", "edit_size=16", "network_sizes=[16]", "rounds=1", f"surfels={SURFELS}"]
    toy += ["variants=[llvm_ad_rgb]", "threads=1"]
    out = tmp_path / "out"
    given = [f"benchmark.{each}" for each in toy]
    assert run(*given, f"renderer=[{pair},{lit}]", f"output_dir={out}") == 0
    results, times = Results.load(out / "results.json"), json.loads((out / "times.json").read_text())
    names = ["pbr", "pbr_x_irradiance_2", "pbr_x_irradiance_64", "lit_preview", "lit"]
    names += [f"{network}_k{frames}" for network in ("neural", "neural_lit") for frames in (1, 5)]
    for name in names:
        frames = 5 if name.endswith("_k5") else 1
        seconds = times["cpu frames 16"][name][0]
        assert results.value(f"speed.cpu.fps.{name}.16") == pytest.approx(frames / seconds, rel=1e-3)
        for edit in ("light", "material", "object"):
            seconds = times[f"cpu {edit} 16"][name][0]
            found = results.value(f"speed.cpu.first_frame_ms.{name}.{edit}")
            assert found == pytest.approx(1e3 * seconds, rel=1e-3)
    assert (results.value("speed.network.neural_lit.training_fps.16") or 0) > 0
    assert (results.value("speed.network.neural.seconds.16") or 0) > 0
    assert results.value("paper.fps.full") == PAPER["full"][0]
    page = (out / "report.html").read_text()
    assert '<section id="cpu">' in page
    assert '<section id="gpu">' not in page


@pytest.mark.parametrize("edit", ["light", "material", "object"])
def test_what_is_timed_after_an_edit_is_the_edited_scene(edit):
    """As a relighter of the edited scene draws it that was made from nothing."""
    world = draw_world(0, "speed", 0, "sun", things=2)
    lights, cameras = Lights(world, SURFELS, 0), orbit(24, 0)[:1]
    way = Way("lit", FINAL, lambda light, some: _lit(0, light, some))
    before = way.frame(lights, cameras, iter([0]))
    shown = way.after(lights, cameras, edit, iter([3]))
    edited = lights.edited(FINAL, edit, 3)
    anew = Relighter(edited.relighter.scene, FINAL, 0, proxy="never").under(edited.lighting.environment)
    np.testing.assert_allclose(shown, _lit(0, anew, cameras), rtol=0.05, atol=0.05)
    assert np.abs(shown - before).max() > 0.02


def test_weights_that_are_not_there_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert run("renderer=nothing.safetensors", f"output_dir={out}") == 2
    assert "weights not found" in capsys.readouterr().err
    assert not out.exists()

"""Benchmark `compare`: figures against other code, ours as a foreign method, faults never averaged away."""

# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalOperand=false, reportReturnType=false, reportOperatorIssue=false
import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from eval.cli import cli, main
from eval.compare.benchmark import p_values
from eval.compare.published import published
from eval.compare.scores import albedo_figures, hdr_figures
from eval.protocol.method import Method, write_method
from eval.protocol.suite import Suite
from eval.relighting.baselines import predictions
from eval.relighting.scores import Scores
from eval.results import Results
from tron.cameras import Camera
from tron.color import linear_to_srgb, to_display
from tron.errors import TronError
from tron.metrics import scale_albedo
from tron.seeds import generator
from tron.shards.schema import Clip


def rebuild(suite: Suite, folder: Path, change: Callable[..., np.ndarray], **said: object) -> Path:
    """A method's folder: the truth of every light, changed: change(radiance, exposure)."""
    method = Method.model_validate(
        {"name": folder.name, "suite": suite.id, "color_space": "linear", "background": "environment"} | said
    )
    with write_method(folder, method) as out:
        for scene in suite.scenes.values():
            for light, of in scene.lights.items():
                out.frames(scene.name, light, change(scene.truth(light), of.exposure))
    return folder


def compare(suite: Suite, methods: Path, output_dir: Path) -> Results:
    main(cli.compose(*arguments(suite.folder, methods), f"output_dir={output_dir}"))
    return Results.load(output_dir / "results.json")


def arguments(suite: Path, methods: Path) -> list[str]:
    return ["benchmark=compare", f"suite={suite}", f"methods={methods}"]


@pytest.fixture
def suite(drawn_suite: Path) -> Suite:
    return Suite.load(drawn_suite)


def test_our_own_output_as_a_foreign_method_has_the_same_figures(
    suite: Suite, drawn_clip: Callable[..., Clip], tmp_path: Path
):
    """compare.identical_rows: in memory by benchmark=relighting's scores, and from a folder of anyone's."""
    scores, ours = Scores(), tmp_path / "methods/foreign"
    method = Method(name="foreign", suite=suite.id, color_space="display", background="environment")
    with write_method(ours, method) as out:
        for seed, scene in enumerate(suite.scenes.values()):
            for light in scene.lights:
                clip = drawn_clip(light.partition("_")[2], seed)
                shown = {r: {"lit": images["lit"]} for r, images in predictions(clip, {}).items()}
                truth = to_display(scene.truth(light), scene.lights[light].exposure)
                scores.add(clip, shown, truth)
                out.frames(scene.name, light, shown["frame"]["lit"])
    results = compare(suite, ours.parent, tmp_path / "out")
    rows = {row.metric: row for row in scores.rows()}
    assert results.value("compare.identical_rows") == 1
    for figure in ("psnr", "ssim", "psnr_full", "ssim_full"):
        in_memory, as_foreign = rows[f"lit.{figure}"], results.find(f"foreign.{figure}")
        assert as_foreign is not None
        assert as_foreign.value == pytest.approx(in_memory.value, abs=1e-6)
        assert as_foreign.n == in_memory.n
        assert as_foreign.low == pytest.approx(in_memory.low, abs=1e-6)
    assert rows["lit.psnr"].value < 60  # a picture of its own, not the truth again


def test_all_colour_spaces_of_one_picture_have_one_figure(suite: Suite, tmp_path: Path):
    def dimmed(radiance: np.ndarray, _: float = 1.0) -> np.ndarray:
        return radiance * 0.5 * (radiance < 2)  # nothing that 8 bits would clip

    rebuild(suite, tmp_path / "m/linear", dimmed)
    rebuild(suite, tmp_path / "m/shown", lambda r, e: to_display(dimmed(r), e), color_space="display")
    rebuild(
        suite, tmp_path / "m/srgb", lambda r, e: linear_to_srgb(dimmed(r) * np.float32(e)), color_space="srgb"
    )
    results = compare(suite, tmp_path / "m", tmp_path / "out")
    expected = results.value("linear.psnr")
    for name in ("shown", "srgb"):
        assert results.value(f"{name}.psnr") == pytest.approx(expected, abs=0.01)
        assert results.value(f"{name}.flip") == pytest.approx(results.value("linear.flip"), abs=1e-3)
        assert results.value(f"{name}.hdr_flip") is None
    assert results.value("linear.hdr_flip") == pytest.approx(0.3, abs=0.3)


def test_the_factor_on_light_is_found_once_a_scene(suite: Suite, tmp_path: Path):
    rebuild(suite, tmp_path / "m/absolute", lambda r, _: r * np.float32(0.25))
    rebuild(suite, tmp_path / "m/scaled", lambda r, _: r * np.float32(0.25), scale="scene")
    results = compare(suite, tmp_path / "m", tmp_path / "out")
    assert (results.value("absolute.psnr") or 0) < 25 < 55 < (results.value("scaled.psnr") or 0)
    with open(tmp_path / "out/scenes.csv", newline="") as file:
        factors = {
            row["factor"] for row in csv.DictReader(file) if row["method"] == "scaled" and row["light"]
        }
    assert [float(each) for each in factors] == [pytest.approx(4.0, rel=1e-3)] * 2


def test_what_stands_behind_is_not_judged_unless_it_is_the_same(suite: Suite, tmp_path: Path):
    """White surroundings change no figure: those of the environment's owner are the witness."""
    folder = rebuild(suite, tmp_path / "m/same", lambda r, _: r * np.float32(0.9))
    said = {"suite": suite.id, "color_space": "linear", "background": "white"}
    with write_method(tmp_path / "m/white", Method.model_validate({"name": "white"} | said)) as out:
        for scene in suite.scenes.values():
            mask = scene.mask()
            assert mask is not None
            for light in scene.lights:
                out.frames(scene.name, light, np.where(mask[..., None] > 0.5, scene.truth(light) * 0.9, 50))
    results = compare(suite, folder.parent, tmp_path / "out")
    assert results.find("same.psnr_full") is not None
    assert results.find("white.psnr_full") is None
    assert results.value("white.psnr") == pytest.approx(results.value("same.psnr"), abs=0.01)
    # SSIM and FLIP look at neighbours; beside white they would be off by far more than this.
    assert results.value("white.ssim") == pytest.approx(results.value("same.ssim"), abs=0.005)
    assert results.value("white.flip") == pytest.approx(results.value("same.flip"), abs=0.005)


def test_faults_are_named_and_never_averaged_away(suite: Suite, tmp_path: Path):
    rebuild(suite, tmp_path / "m/good", lambda r, _: r * np.float32(0.8))
    bad = rebuild(suite, tmp_path / "m/bad", lambda r, _: r * np.float32(0.9))
    shutil.rmtree(bad / "drawn-000001/2_dusk")
    results = compare(suite, tmp_path / "m", tmp_path / "out")
    assert results.value("bad.faults") == 1
    assert results.find("bad.psnr") is None
    assert results.find("bad.psnr.sun") is None
    assert results.find("good.psnr") is not None
    common = {name: results.value(f"{name}.psnr_common") for name in ("good", "bad")}
    assert common["bad"] == pytest.approx(results.value("bad.scene_psnr.drawn_000000"))
    assert common["good"] == pytest.approx(results.value("good.scene_psnr.drawn_000000"))
    assert results.value("bad.gain_over_good") == pytest.approx(common["bad"] - common["good"])  # type: ignore
    (fault,) = results.environment["inputs"]["faults"]["bad"]
    assert (fault["scene"], fault["what"], fault["kind"]) == ("drawn-000001", "2_dusk", "missing_light")
    html = (tmp_path / "out/report.html").read_text()
    assert "missing_light" in html
    assert "light 2_dusk is missing" in (tmp_path / "out/faults.csv").read_text()
    # A column of the LaTeX table: the dash of who failed, and the best of the others, bold.
    tex = (tmp_path / "out/table.tex").read_text().splitlines()
    assert next(line for line in tex if line.startswith("bad")).split("&")[1].strip() == "--"
    assert rf"\textbf{{{results.value('good.psnr'):.2f}}}" in next(
        line for line in tex if line.startswith("good")
    )


def test_maps_are_judged_by_all_three_scalings(suite: Suite, tmp_path: Path):
    folder = rebuild(suite, tmp_path / "m/maps", lambda r, _: r)
    with write_method(
        folder,
        Method.model_validate(
            {"name": "maps", "suite": suite.id, "color_space": "linear", "background": "environment"}
        ),
    ) as out:
        for scene in suite.scenes.values():
            out.albedo(scene.name, scene.albedo() * np.float32(0.5))
            out.normals(scene.name, scene.normals())
    results = compare(suite, tmp_path / "m", tmp_path / "out")
    assert (results.value("maps.albedo_psnr") or 0) > 55
    assert (results.value("maps.albedo_psnr_median") or 0) > 55
    assert (results.value("maps.albedo_psnr_unscaled") or 99) < 15
    assert results.value("maps.normal_mae_deg") == pytest.approx(0, abs=1e-3)


def test_albedo_is_scaled_by_view_or_by_scene():
    """Two views, one of which is twice as bright: a factor a view mends it, one of both views cannot."""
    rng = generator(0, "test", "albedo")
    truth = rng.uniform(0.2, 0.45, (2, 16, 16, 3)).astype(np.float32)
    given = truth * np.array([1.0, 2.0], np.float32)[:, None, None, None]
    inside = np.ones((2, 16, 16), bool)
    found = albedo_figures(given, truth, inside)
    assert found["albedo_psnr"] > 80
    ratio = np.median((truth / given).reshape(-1, 3), axis=0)  # both halves: between 0.5 and 1
    error = [np.mean((np.clip(g * ratio, 0, 1) - t) ** 2) for g, t in zip(given, truth)]
    assert found["albedo_psnr_median"] == pytest.approx(np.mean([-10 * np.log10(e) for e in error]), abs=1e-3)
    assert scale_albedo(given[1], truth[1]) == pytest.approx(truth[1], abs=1e-5)


def test_normals_in_another_frame_than_said_are_a_fault(suite: Suite, tmp_path: Path):
    folder = rebuild(suite, tmp_path / "m/turned", lambda r, _: r)
    method = {"name": "turned", "suite": suite.id, "color_space": "linear", "background": "environment"}
    with write_method(folder, Method.model_validate(method)) as out:
        for scene in suite.scenes.values():
            turns = np.stack([camera.world_to_camera[:3, :3] for camera in scene.cameras])
            out.normals(scene.name, np.einsum("kij,khwj->khwi", turns, scene.normals()))
    results = compare(suite, tmp_path / "m", tmp_path / "out")
    assert results.find("turned.normal_mae_deg") is None
    assert results.value("turned.faults") == 2
    assert {fault["kind"] for fault in results.environment["inputs"]["faults"]["turned"]} == {"wrong_frame"}
    assert results.find("turned.psnr") is not None


def test_p_values_are_those_of_all_sign_flips():
    differences = np.array([0.5, 0.7, -0.1, 0.9, 0.4, 0.6])
    flips = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1)
    means = (differences[:, None] * flips).mean(0)
    expected = (np.abs(means) >= abs(differences.mean()) - 1e-12).mean()
    (found,) = p_values([differences], 0)
    assert found == pytest.approx(expected)
    assert p_values([differences[:4]], 0) == [None]
    both = p_values([differences, np.array([0.1, -0.1, 0.2, -0.2, 0.05])], 0)
    assert both[0] == pytest.approx(min(2 * expected, both[1] or 1))  # adjusted for two


def test_hdr_flip_sees_what_the_tone_curve_hides():
    """Highlights of 20 and of 60 are both white on a screen."""
    pytest.importorskip("flip_evaluator")
    truth = np.full((24, 24, 3), 0.4, np.float32)
    truth[8:16, 8:16] = 20
    other, mask = truth.copy(), np.ones((24, 24), bool)
    other[8:16, 8:16] = 60
    assert hdr_figures(truth, truth, mask)["hdr_flip"] == pytest.approx(0, abs=1e-6)
    assert hdr_figures(other, truth, mask)["hdr_flip"] > 0.01
    black = np.zeros_like(truth)
    mask[:4] = False
    assert hdr_figures(black, black, mask) == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda suite, methods: [suite, methods.parent / "none"], "has a method.yaml"),
        (lambda suite, methods: [suite.parent, methods], "no suite.yaml"),
        (lambda suite, methods: ["null", methods], "no suite or no methods"),
        (lambda suite, methods: [suite, f"[{methods}/a,{methods}/a]"], "two methods are named a"),
    ],
)
def test_wrong_input_is_one_line_before_any_work(
    suite: Suite,
    tmp_path: Path,
    change: Callable[[Path, Path], list],
    words: str,
    capsys: pytest.CaptureFixture,
):
    rebuild(suite, tmp_path / "m/a", lambda r, _: r)
    given = change(suite.folder, tmp_path / "m")
    with pytest.raises(SystemExit) as end:
        cli([*arguments(*given), f"output_dir={tmp_path / 'out'}"])
    assert end.value.code == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


def test_a_suite_of_photos_has_nothing_to_compare_with(suite: Suite, tmp_path: Path):
    from eval.protocol.suite import NewScene, write_suite
    from tron.shading.environments.environment import EnvironmentMap

    camera = Camera.look_at((0, -3, 1), (0, 0, 0), fov_deg=40, width=16, height=16)
    light = (EnvironmentMap.constant(1.0), 1.0, "", None)
    scene = NewScene("room", "photos", lambda path: path.mkdir(), None, [camera], {"0_sky": light}, {})
    photos = write_suite(tmp_path / "photos", "photos", [scene])
    with pytest.raises(TronError, match="knows no truth"):
        main(cli.compose(*arguments(photos.folder, tmp_path), f"output_dir={tmp_path / 'out'}"))


def test_lpips_has_a_row_where_its_weights_are_given(suite: Suite, tmp_path: Path, random_vgg: Path):
    """Against the metric called plainly, on pictures with the truth around the subject."""
    from tron.metrics import LPIPS

    rebuild(suite, tmp_path / "m/dim", lambda r, _: r * np.float32(0.5), background="none")
    scene, tail = (
        suite.scenes["drawn-000000"],
        [f"output_dir={tmp_path / 'out'}", f"benchmark.lpips={random_vgg}"],
    )
    main(cli.compose(*arguments(suite.folder, tmp_path / "m"), *tail))
    mask, truth = scene.mask(), scene.truth("1_noon")
    assert mask is not None
    pair = [to_display(x, 0.4)[0] for x in (np.where(mask[..., None] > 0.5, 0.5 * truth, truth), truth)]
    a, b = (torch.from_numpy(2 * np.float32(x) - 1).movedim(-1, 0)[None] for x in pair)
    with open(tmp_path / "out/frames.csv", newline="") as file:
        row = next(csv.DictReader(file))
    assert (row["scene"], row["light"], row["frame"]) == ("drawn-000000", "1_noon", "0")
    assert float(row["lpips"]) == pytest.approx(float(LPIPS.load(random_vgg)(a, b)[0]), rel=1e-4)
    assert Results.load(tmp_path / "out/results.json").find("dim.lpips") is not None


def test_the_papers_figures_are_called_the_papers():
    captions = [table.caption for table in published("tron_synth_small-0123456789ab")]
    assert [caption.partition(",")[0] for caption in captions] == ["TRON-Synth Objects", "TRON-Synth Scenes"]
    assert all("the paper's figures on its own data" in caption for caption in captions)
    (tensoir,) = published("tensoir-0123456789ab")
    assert [cell.text for cell in tensoir.cells[-1]] == ["TRON", "34.10 dB", "0.964", "0.069", "4.37°"]
    assert published("drawn-0123456789ab") == []

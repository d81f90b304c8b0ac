"""Laws of the whole run: what each prior teaches, and that an interrupted run is the uninterrupted one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tron.captures import Capture
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.gaussians.harmonics import SH_C0
from tron.reconstruction import Reconstruction, reconstruct
from tron.reconstruction.geometry.training import Stage, StepSummary
from tron.reconstruction.priors import GroundTruth, Joint
from tron.reconstruction.scores import mean_figures, score_views
from tron.reconstruction.settings import (
    ConsistencySettings,
    DensitySettings,
    InitialSettings,
    MaterialSettings,
    RadianceSettings,
    ReconstructionSettings,
)
from tron.tracing import SurfelTracer

DENSITY = DensitySettings(start=0, end=16, every=6, threshold=1e-5, prune_every=4, reset_every=0, most=420)


def settings(**changes: Any) -> ReconstructionSettings:
    """A dozen and some steps, with density changes; rates for so few."""
    radiance = RadianceSettings(
        steps=14, position_rate=1e-3, sh_rate=0.05, scale_rate=0.02, sh_every=4, normal=0.1, density=DENSITY,
        consistency=ConsistencySettings(every=6),
    )  # fmt: skip
    values = {
        "initial": InitialSettings(source="depth", count=300, kernel_degree=2),
        "radiance": radiance,
        "materials": MaterialSettings(steps=6, rate=0.03, decay=1),
        "steps_scaler": 1,
        "checkpoint_every": 5,
    }
    return ReconstructionSettings(**{**values, **changes})


def without(capture: Capture, *names: str) -> Capture:
    """The capture, its training views without some maps."""
    kept = (v if v.name in capture.test else replace(v, **dict.fromkeys(names)) for v in capture.views)
    return replace(capture, views=tuple(kept))


def same(one: GaussianScene, other: GaussianScene) -> bool:
    pairs = ((getattr(one, f.name), getattr(other, f.name)) for f in fields(GaussianScene))
    return all(np.array_equal(a, b) for a, b in pairs)


class Cut(Exception):
    """Stands for whatever ends a process."""


class CutAt:
    """A watch that counts steps and ends the run after one of them."""

    def __init__(self, stage: str = "", step: int = 0) -> None:
        self.at, self.steps = (stage, step), []

    def __call__(self, progress: StepSummary, stage: Stage) -> None:
        self.steps.append((progress.stage, progress.step))
        if self.steps[-1] == self.at:
            raise Cut


@pytest.fixture(scope="module")
def truthful(painted_capture: Capture) -> Reconstruction:
    """Forty steps and forty with the true maps, from depth."""
    longer = settings(
        radiance=settings().radiance.model_copy(update={"steps": 40}),
        materials=MaterialSettings(steps=40, rate=0.03, decay=1),
    )
    return reconstruct(painted_capture, GroundTruth(), longer)


def test_true_maps_teach_normals_and_all_materials(
    truthful: Reconstruction, painted_capture: Capture
) -> None:
    assert truthful.learnt == ("base_color", "roughness", "metallic")
    figures = mean_figures(score_views(SurfelTracer(truthful.scene), painted_capture.test_views))
    assert figures["psnr"] > 22
    assert figures["normal_mae_deg"] < 15
    assert figures["base_color_psnr"] > 22
    assert figures["roughness_mae"] < 0.1
    assert truthful.seconds["surfels"] > 0


def test_base_color_begins_as_the_radiance(painted_capture: Capture) -> None:
    """Without a step of stage 2, and without a prior, base color is the decoded SH DC."""
    for prior_maps, steps in ((("base_color", "roughness", "metallic"), 6), ((), 0)):
        found = reconstruct(
            without(painted_capture, *prior_maps),
            GroundTruth(),
            settings(materials=MaterialSettings(steps=steps, decay=1)),
        ).scene
        expected = srgb_to_linear(np.clip(SH_C0 * found.sh[:, 0] + 0.5, 0, 1))
        np.testing.assert_allclose(found.base_color, expected, atol=1e-6)


def test_what_a_prior_lacks_stays_as_it_was_and_is_said(painted_capture, caplog) -> None:
    capture = without(painted_capture, "metallic", "roughness")
    with caplog.at_level(logging.WARNING):
        found = reconstruct(
            capture, GroundTruth(), settings(initial=InitialSettings(source="random", count=200))
        )
    assert found.learnt == ("base_color",)
    assert (found.scene.roughness == 0.5).all()
    assert (found.scene.metallic == 0).all()
    assert "no prior for roughness" in caplog.text
    assert "no prior for metallic" in caplog.text


def test_held_out_views_are_looked_at_for_scores_alone(painted_capture: Capture) -> None:
    learnt = False

    def watch(progress: StepSummary, _: Stage) -> None:
        nonlocal learnt
        learnt = progress.stage == "materials" and progress.step == progress.steps

    def late(values: Any) -> Callable[[], Any]:
        def read() -> Any:
            assert learnt, "a held-out view was read before all was learnt"
            return values

        return read

    hidden = tuple(
        replace(v, image=late(v.read()), mask=late(v.read("mask")), normal=late(v.read("normal")))
        if v.name in painted_capture.test
        else v
        for v in painted_capture.views
    )
    found = reconstruct(replace(painted_capture, views=hidden), GroundTruth(), settings(), watch=watch)
    assert {score.view for score in found.scores["test"]} == painted_capture.test
    assert found.light is None, "none was asked for"


@pytest.mark.parametrize(
    "cut",
    [
        ("radiance", 13),
        pytest.param(("materials", 2), marks=pytest.mark.long),
        pytest.param(("materials", 5), marks=pytest.mark.long),
    ],
    ids=str,
)
def test_an_interrupted_run_is_the_uninterrupted_one_bit_by_bit(
    painted_capture, one_thread, tmp_path: Path, whole: Reconstruction, cut: tuple[str, int]
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    prior = GroundTruth()
    with pytest.raises(Cut):
        reconstruct(painted_capture, prior, settings(), checkpoint=path, watch=CutAt(*cut))
    watch = CutAt()
    found = reconstruct(painted_capture, prior, settings(), checkpoint=path, watch=watch)
    lost = cut[1] % 5 if cut[0] == "radiance" or cut[1] >= 5 else cut[1]
    assert watch.steps[0] == (cut[0], cut[1] - lost + 1)
    assert same(found.scene, whole.scene)


@pytest.mark.parametrize(
    "cut",
    [pytest.param(6, marks=pytest.mark.long), 9, pytest.param(13, marks=pytest.mark.long)],
    ids=["after a size's last step", "amid a size", "whole photos"],
)
def test_a_run_from_coarse_to_fine_outlives_an_interruption_bit_by_bit(
    painted_capture, one_thread, tmp_path: Path, cut: int
) -> None:
    """Sizes change before steps 5 and 10 (from 0) and a checkpoint comes every five: on their borders too."""
    capture, prior = without(painted_capture, "normal"), GroundTruth()
    fine = settings(radiance=settings().radiance.model_copy(update={"coarse": (5 / 14, 5 / 14)}))
    undisturbed = reconstruct(capture, prior, fine)
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(Cut):
        reconstruct(capture, prior, fine, checkpoint=path, watch=CutAt("radiance", cut))
    assert same(reconstruct(capture, prior, fine, checkpoint=path).scene, undisturbed.scene)
    assert not same(undisturbed.scene, reconstruct(capture, prior, settings()).scene)


@pytest.fixture(scope="module")
def whole(painted_capture: Capture) -> Reconstruction:
    """The run that nobody interrupts, on one thread."""
    import drjit as dr
    import torch

    dr.set_thread_count(1)
    torch.set_num_threads(1)
    found = reconstruct(painted_capture, GroundTruth(), settings())
    assert len(found.scene) != 300  # density control had its say
    return found


def test_small_photos_have_room_for_fewer_surfels(painted_capture, one_thread, whole: Reconstruction) -> None:
    camera, base = painted_capture.train_views[0].camera, settings()
    density = DENSITY.model_copy(update={"per_pixel": 310 / (camera.width * camera.height)})
    radiance = base.radiance.model_copy(update={"density": density})
    found = reconstruct(painted_capture, GroundTruth(), base.model_copy(update={"radiance": radiance}))
    assert 290 < len(found.scene) <= 310 < len(whole.scene)


@pytest.mark.long
def test_surfels_that_close_a_room_outlive_an_interruption(
    painted_capture, one_thread, tmp_path: Path, whole: Reconstruction
) -> None:
    closed = reconstruct(painted_capture, GroundTruth(), settings(indoors=True))
    assert len(closed.scene) > len(whole.scene)
    assert np.array_equal(closed.scene.means[: len(whole.scene)], whole.scene.means)
    for which, before in whole.scores.items():
        for score, other in zip(closed.scores[which], before, strict=True):
            assert score.figures["psnr"] == other.figures["psnr"], "judged as it was learnt"
    for cut in (("radiance", 13), ("materials", 5)):
        path = tmp_path / f"{cut[0]}.safetensors"
        with pytest.raises(Cut):
            reconstruct(
                painted_capture, GroundTruth(), settings(indoors=True), checkpoint=path, watch=CutAt(*cut)
            )
        again = reconstruct(painted_capture, GroundTruth(), settings(indoors=True), checkpoint=path)
        assert same(again.scene, closed.scene)
        assert again.scores == closed.scores


def test_a_finished_run_is_not_trained_again(painted_capture, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    first = reconstruct(painted_capture, GroundTruth(), settings(), checkpoint=path)
    watch = CutAt()
    second = reconstruct(painted_capture, GroundTruth(), settings(), checkpoint=path, watch=watch)
    assert watch.steps == []
    assert same(first.scene, second.scene)
    assert second.seconds["surfels"] >= first.seconds["surfels"] - 0.5
    third = reconstruct(
        painted_capture, GroundTruth(), settings(checkpoint_every=50), checkpoint=path, watch=watch
    )
    assert watch.steps == []  # how often it is saved changes nothing else
    assert same(first.scene, third.scene)


def test_a_checkpoint_of_another_run_is_refused_by_the_name_of_what_differs(
    painted_capture, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    brief = settings(
        radiance=settings().radiance.model_copy(update={"steps": 1}), materials=MaterialSettings(steps=0)
    )
    reconstruct(painted_capture, GroundTruth(), brief, checkpoint=path)
    before = path.read_bytes()
    dense = brief.radiance.density.model_copy(update={"most": 99})
    others = {
        "seed": (painted_capture, GroundTruth(), brief.model_copy(update={"seed": 1})),
        "radiance.density.most": (
            painted_capture,
            GroundTruth(),
            brief.model_copy(update={"radiance": brief.radiance.model_copy(update={"density": dense})}),
        ),
        "prior": (painted_capture, Joint(), brief),
        "capture": (replace(painted_capture, test=frozenset({"01"})), GroundTruth(), brief),
    }
    for key, (capture, prior, other) in others.items():
        with pytest.raises(TronError, match=f"a checkpoint made with (another )?{key}") as caught:
            reconstruct(capture, prior, other, checkpoint=path)
        assert "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_bad_captures_are_refused_before_work(painted_capture: Capture) -> None:
    one = Capture(painted_capture.views[:1])
    with pytest.raises(TronError, match="at least two training views"):
        reconstruct(one, GroundTruth(), settings())
    linear = replace(painted_capture.views[1], space="linear")
    views = (painted_capture.views[0], linear, painted_capture.views[2])
    with pytest.raises(TronError, match=r"display values.*view 01"):
        reconstruct(Capture(views), GroundTruth(), settings())


@pytest.mark.parametrize(
    ("source", "words"), [("points", "no points"), ("depth", "no training view has a depth")]
)
def test_a_source_that_is_not_there_is_told_before_a_prior_works(
    painted_capture: Capture, source, words: str
) -> None:
    class Asked(GroundTruth):
        def prepare(self, capture, fields):
            raise AssertionError("the prior was asked first")

    wanted = settings(initial=InitialSettings(source=source))
    with pytest.raises(TronError, match=words):
        reconstruct(without(painted_capture, "depth"), Asked(), wanted)


def test_a_steps_scaler_shortens_both_stages(painted_capture: Capture) -> None:
    watch = CutAt()
    reconstruct(painted_capture, GroundTruth(), settings(steps_scaler=0.5), watch=watch)
    assert [sum(name == stage for name, _ in watch.steps) for stage in ("radiance", "materials")] == [7, 3]


@pytest.mark.parametrize(("source", "faster"), [("random", 2.0), ("depth", 1.0)])
def test_surfels_that_have_a_way_to_go_take_longer_steps_when_there_are_few(
    painted_capture: Capture, source, faster: float
) -> None:
    rates: dict[float, dict[str, float]] = {}
    for scaler in (1.0, 0.25):

        def watch(_: StepSummary, stage: Stage, scaler: float = scaler) -> None:
            rates[scaler] = stage.plan.rates
            raise Cut

        wanted = settings(initial=InitialSettings(source=source, count=100), steps_scaler=scaler)
        with pytest.raises(Cut):
            reconstruct(painted_capture, GroundTruth(), wanted, watch=watch)
    for name in ("means", "quats"):
        assert rates[0.25][name] == pytest.approx(faster * rates[1.0][name]), name
    assert rates[0.25]["log_scales"] == rates[1.0]["log_scales"]


def test_surfels_never_outnumber_the_cap(painted_capture: Capture) -> None:
    counts: list[int] = []
    many = settings(initial=InitialSettings(source="random", count=600))
    reconstruct(
        painted_capture, GroundTruth(), many, watch=lambda progress, _: counts.append(progress.surfels)
    )
    assert max(counts) <= DENSITY.most

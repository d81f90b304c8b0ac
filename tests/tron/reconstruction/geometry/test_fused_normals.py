"""Laws of the normals that views agree on: their loss, their truth, and that a checkpoint keeps them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tron.captures import Capture, View
from tron.gaussians import GaussianScene
from tron.metrics import angular_error_deg
from tron.reconstruction.geometry.fused_normals import FusedNormals, normal_consistency
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.geometry.training import Stage, radiance_plan
from tron.reconstruction.settings import ConsistencySettings, RadianceSettings
from tron.seeds import generator
from tron.tracing.torch_bridge import render

RATES = {"quats": 1e-2}
SETTINGS = ConsistencySettings(sigma=1.0, every=10)


def test_the_loss_is_the_weighted_turn_of_the_surfels_from_the_fused_normal() -> None:
    """One pixel, two surfels of weights 0.6 and 0.3: 0.6 (1 - n1 . N) + 0.3 (1 - n2 . N)."""
    one, two = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])
    wanted = np.array([0.0, 0.0, 1.0])
    rendered = {
        "opacity": torch.tensor([[0.9, 0.9]]),
        "normal_sum": torch.tensor(np.tile(0.6 * one + 0.3 * two, (1, 2, 1))).float(),
    }
    fused = torch.zeros(1, 2, 3)
    fused[0, 0] = torch.from_numpy(wanted)  # nobody knows the second pixel
    expected = 0.6 * (1 - one @ wanted) + 0.3 * (1 - two @ wanted)
    assert float(normal_consistency(rendered, fused)) == pytest.approx(expected, abs=1e-6)
    assert float(normal_consistency(rendered, torch.zeros(1, 2, 3))) == 0


def test_fused_normals_are_the_surfaces(painted: GaussianScene, painted_capture: Capture) -> None:
    views = painted_capture.train_views
    fused = FusedNormals(SETTINGS, painted.kernel_degree)
    assert fused.of(views[0]) == {}
    fused.make(LearntSurfels.of_scene(painted, RATES), views)
    for view in views:
        normal = fused.of(view)["fused_normal"].cpu().numpy()
        known = normal.any(-1) & (view.read("depth") > 0)
        assert known.sum() > 0.6 * (view.read("depth") > 0).sum()
        assert angular_error_deg(normal, view.read("normal"), known) < 12


def test_masks_carve_surfels_that_no_photo_shows(painted: GaussianScene, painted_capture: Capture) -> None:
    """Photos with empty masks: whatever the surfels say, there is no surface to take normals from."""
    views, surfels = painted_capture.train_views, LearntSurfels.of_scene(painted, RATES)
    known = []
    for masks in (True, False):
        shown = [view if masks else replace(view, mask=np.zeros((32, 32))) for view in views]
        fused = FusedNormals(SETTINGS, painted.kernel_degree)
        fused.make(surfels, shown)
        known.append(
            np.mean([fused.of(view)["fused_normal"].any(-1).float().mean().item() for view in shown])
        )
    assert known[1] < 0.2 * known[0]


def test_surfels_that_are_turned_turn_back(painted: GaussianScene, painted_capture: Capture) -> None:
    """Normals that are off by some 17 degrees, at places that are right."""
    surfels = LearntSurfels.of_scene(painted, RATES)
    views = painted_capture.train_views
    turn = torch.from_numpy(0.15 * generator(0, "turned").normal(size=surfels["quats"].shape)).float()
    surfels.replace("quats", surfels["quats"].detach() + turn.to(surfels.device))
    fused = FusedNormals(SETTINGS, painted.kernel_degree)
    fused.make(surfels, views)
    off = [error_of(surfels, painted, painted_capture)]
    for step in range(40):
        view = views[step % len(views)]
        seen = render(surfels.rendered(), view.camera, kernel_degree=painted.kernel_degree, sh_degree=0)
        loss = normal_consistency(seen, fused.of(view)["fused_normal"])
        surfels.clear_gradients()
        loss.backward()
        surfels.step()
    off.append(error_of(surfels, painted, painted_capture))
    assert off[0] > 8
    assert off[1] < 0.6 * off[0]


def error_of(surfels: LearntSurfels, scene: GaussianScene, capture: Capture) -> float:
    """Mean angle between the rendered normals and the true ones, degrees."""
    errors = []
    with torch.no_grad():
        for view in capture.train_views:
            seen = render(surfels.rendered(), view.camera, kernel_degree=scene.kernel_degree, sh_degree=0)
            known = view.read("normal").any(-1) & (seen["opacity"].cpu().numpy() > 0.5)
            errors.append(angular_error_deg(seen["normal"].cpu().numpy(), view.read("normal"), known))
    return float(np.mean(errors))


def test_they_are_those_of_when_they_were_made_and_come_back_from_their_state(
    painted: GaussianScene, painted_capture: Capture, one_thread
) -> None:
    views = painted_capture.train_views
    surfels = LearntSurfels.of_scene(painted, {"means": 1e-3})
    fused = FusedNormals(SETTINGS, painted.kernel_degree)
    fused.make(surfels, views)
    first = fused.of(views[0])["fused_normal"]
    surfels.replace("means", surfels["means"].detach() * 1.2)
    assert torch.equal(fused.of(views[0])["fused_normal"], first)
    kept = {name: values.clone() for name, values in fused.state().items()}
    again = FusedNormals(SETTINGS, painted.kernel_degree)
    again.restore(kept, surfels.device, views)
    assert torch.equal(again.of(views[0])["fused_normal"], first)
    fused.make(surfels, views)
    assert not torch.equal(fused.of(views[0])["fused_normal"], first)


def test_a_stage_makes_them_when_they_are_due_and_when_its_pictures_grow(
    painted: GaussianScene, painted_capture: Capture
) -> None:
    consistency = ConsistencySettings(every=4)
    plan = radiance_plan(RadianceSettings(steps=10, consistency=consistency, coarse=(0.3, 0.4)), 4.0, 0)
    surfels = LearntSurfels.of_scene(painted, plan.rates)
    stage = Stage(plan, painted_capture.train_views, surfels, painted.kernel_degree, 0)
    assert stage.fused is not None
    make, made = stage.fused.make, []

    def noted(surfels: LearntSurfels, views: Sequence[View]) -> None:
        made.append((stage.step, views[0].camera.width))
        make(surfels, views)

    stage.fused.make = noted
    stage.run()
    assert made == [(0, 8), (3, 16), (4, 16), (7, 32), (8, 32)]


def test_a_priors_normals_take_their_place(painted: GaussianScene, painted_capture: Capture) -> None:
    settings = RadianceSettings(steps=4)
    for given in (False, True):
        plan = radiance_plan(settings, 4.0, 0, normals_given=given)
        surfels = LearntSurfels.of_scene(painted, plan.rates)
        stage = Stage(plan, painted_capture.train_views, surfels, painted.kernel_degree, 0)
        assert (stage.fused is None) == given

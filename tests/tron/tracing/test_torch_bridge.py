"""Laws of rendering from torch: the gradients of Dr.Jit, no copies, no recompilation, no leaks, and a fit."""

from __future__ import annotations

import gc

import drjit as dr
import numpy as np
import pytest
import torch

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.tracing import SurfelTracer, torch_bridge
from tron.tracing.parameters import SurfelParameters
from tron.tracing.torch_bridge import IMAGES, render, tensors_of

CAMERA = Camera.look_at((2.0, 0.7, 0.5), (0, 0, 0), fov_deg=50, width=21, height=14)


@pytest.fixture(autouse=True)
def device(variant) -> str:
    if variant.startswith("cuda") and not torch.cuda.is_available():
        pytest.skip("this torch has no CUDA")
    return "cuda" if variant.startswith("cuda") else "cpu"


def view(angle: float, size: int = 24) -> Camera:
    return Camera.look_at(
        (2 * np.cos(angle), 2 * np.sin(angle), 0.6), (0, 0, 0), fov_deg=50, width=size, height=size
    )


@pytest.mark.parametrize("degree", [2, 4])
def test_images_are_those_of_the_tracer(random_scene, device, degree):
    scene = random_scene(60, degree=degree)
    seen = render(tensors_of(scene), CAMERA, kernel_degree=degree)
    expected = SurfelTracer(scene).gbuffer(CAMERA).numpy()
    length = np.linalg.norm(expected["normal_sum"], axis=-1, keepdims=True)
    mean = expected["normal_sum"] / np.maximum(length, 1e-12)
    one_face = np.abs(mean - expected["normal"]).max(-1) > 1e-5
    assert one_face.mean() < 0.3
    expected["normal"] = mean  # what is differentiated is of no face alone, nor is its point
    expected["position"][one_face] = seen["position"].detach().cpu().numpy()[one_face]
    for name in IMAGES:
        np.testing.assert_allclose(seen[name].detach().cpu().numpy(), expected[name], atol=1e-5, err_msg=name)


def test_backward_gives_the_gradients_of_dr_jit(random_scene, device):
    from tron.tracing.gbuffer import trace_gbuffer
    from tron.tracing.parameters import pack
    from tron.tracing.tiled.tiles import build_tiles

    scene = random_scene(60)
    surfels = tensors_of(scene)
    seen = render(surfels, CAMERA)
    ((seen["rgb"] ** 2).sum() + seen["roughness"].sum() + seen["normal"][..., 1].sum()).backward()

    parameters = SurfelParameters.from_scene(scene)
    for name in PARAMETERS:
        dr.enable_grad(getattr(parameters, name))
    records = pack(parameters)
    direct = trace_gbuffer(records, build_tiles(records.detached(), CAMERA), CAMERA)
    dr.backward(dr.sum(dr.squared_norm(direct.rgb) + direct.roughness + direct.normal.y))
    for name in PARAMETERS:
        expected = np.array(dr.grad(getattr(parameters, name)))
        gradient = surfels[name].grad
        assert gradient is not None
        assert gradient.shape == surfels[name].shape
        np.testing.assert_allclose(
            gradient.cpu().numpy().ravel(),
            expected,
            atol=1e-5 * max(np.abs(expected).max(), 1e-6),
            err_msg=name,
        )


def test_parameters_are_read_where_they_are(random_scene, device, monkeypatch):
    surfels = tensors_of(random_scene(30))
    addresses = {}

    def spy(parameters):
        for name in PARAMETERS:
            addresses[name] = getattr(parameters, name).torch().data_ptr()
        return original(parameters)

    original = torch_bridge.pack
    monkeypatch.setattr(torch_bridge, "pack", spy)
    render(surfels, CAMERA)
    assert addresses == {name: tensor.data_ptr() for name, tensor in surfels.items()}


def test_frozen_tensors_get_no_gradient_and_the_others_keep_theirs(random_scene, device):
    scene = random_scene(60)
    free, frozen = tensors_of(scene), tensors_of(scene)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        frozen[name].requires_grad_(False)
    for surfels in (free, frozen):
        seen = render(surfels, CAMERA)
        (seen["base_color"].sum() + seen["roughness"].sum() + seen["rgb"].sum()).backward()
    assert frozen["means"].grad is None
    for name in ("base_color", "roughness"):
        torch.testing.assert_close(frozen[name].grad, free[name].grad)


def test_a_module_of_parameters_is_optimised_until_the_pictures_agree(random_scene, device):
    scene = random_scene(40, sh_degree=1)
    views = [view(angle) for angle in np.linspace(0, 2 * np.pi, 6, endpoint=False)]
    with torch.no_grad():
        truth = tensors_of(scene)
        photos = [render(truth, camera, sh_degree=1)["rgb"] for camera in views]
    generator = torch.Generator().manual_seed(seeds.integer(0, "tests", "perturbation"))
    surfels = torch.nn.ParameterDict(
        {
            name: torch.nn.Parameter(
                value.detach() + 0.05 * torch.randn(value.shape, generator=generator).to(device)
            )
            for name, value in truth.items()
        }
    )
    optimiser = torch.optim.Adam(surfels.values(), 5e-3, eps=1e-15)
    losses = []
    for step in range(90):
        losses.append(0.0)
        camera, photo = views[step % len(views)], photos[step % len(views)]
        seen = render(dict(surfels), camera, sh_degree=1)
        loss = (seen["rgb"] - photo).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses[-1] = float(loss.detach())
    assert np.mean(losses[-6:]) < 0.35 * np.mean(losses[:6])


def train(surfels: dict[str, torch.Tensor], count: int) -> None:
    optimiser = torch.optim.Adam(surfels.values(), 1e-4)
    for k in range(count):
        seen = render(surfels, view(0.1 * k, 48))
        optimiser.zero_grad()
        (seen["rgb"].mean() + seen["opacity"].mean() + seen["normal"].mean()).backward()
        optimiser.step()


def test_later_views_need_no_other_kernels_and_more_surfels_one(random_scene, device, kernels_of):
    surfels = tensors_of(random_scene(58))
    first = kernels_of(lambda: train(surfels, 20))
    assert first
    assert kernels_of(lambda: train(surfels, 5)) <= first, "compiled anew"
    # Dr.Jit writes the width of the parameters into the kernel that unpacks their gradients.
    assert len(kernels_of(lambda: train(tensors_of(random_scene(64)), 5)) - first) <= 1
    # Room for the records' gradients has grown, and its width is written into the kernel that replays hits.
    assert len(kernels_of(lambda: train(tensors_of(random_scene(75)), 5)) - first) <= 2


def test_steps_keep_nothing(random_scene, device):
    def kept() -> tuple[int, int]:
        """Variables of Dr.Jit and tensors of torch that are alive."""
        gc.collect()
        tensors = sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects())
        return str(dr.whos(as_string=True)).count("\n"), tensors

    surfels = tensors_of(random_scene(60))
    train(surfels, 5)
    variables, tensors = kept()
    train(surfels, 20)
    after = kept()
    assert after[0] <= variables
    assert after[1] <= tensors


def test_tensors_that_cannot_be_read_in_place_are_refused(random_scene, device):
    def changed(name, value):
        return {**tensors_of(random_scene(10)), name: value}

    with pytest.raises(TronError, match=r"means has shape \(3, 10\)"):
        render(changed("quats", torch.zeros(3, 4)) | {"means": torch.zeros(3, 10)}, CAMERA)
    with pytest.raises(TronError, match="quats is not contiguous float32"):
        render(changed("quats", torch.zeros(10, 4, dtype=torch.float64)), CAMERA)
    with pytest.raises(TronError, match="sh is not contiguous"):
        render(changed("sh", torch.zeros(16, 10, 3).transpose(0, 1)), CAMERA)
    with pytest.raises(TronError, match="no metallic"):
        render({k: v for k, v in tensors_of(random_scene(10)).items() if k != "metallic"}, CAMERA)
    with pytest.raises(TronError, match="is on meta"):
        render(changed("means", torch.zeros(10, 3, device="meta")), CAMERA)

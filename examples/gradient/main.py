"""Differentiate the renderer: find where the ball was by comparing pictures. Start, found, wanted."""

import numpy as np
import torch

from examples.stage import BALL, arguments, load_scene, look_at
from tron.io.images import write_image
from tron.tracing.torch_bridge import render, tensors_of

chosen = arguments(__doc__, "gradient.jpg")
scene = load_scene(chosen)
camera = look_at(scene, chosen)[0].resized(*((48, 32) if chosen.small else (384, 256)))
surfels = {name: value.detach() for name, value in tensors_of(scene).items()}
moving = torch.tensor(scene.object_id == BALL if chosen.scene is None else scene.object_id >= 0)


def picture(shift: torch.Tensor) -> torch.Tensor:
    moved = surfels["means"] + moving[:, None] * shift
    return render({**surfels, "means": moved}, camera, kernel_degree=scene.kernel_degree)["rgb"]


wanted = picture(torch.zeros(3)).detach()
shift = torch.tensor([0.1, -0.15, 0.12], requires_grad=True)
first, distance = picture(shift).detach(), float(shift.detach().norm())
optimizer = torch.optim.Adam([shift], 0.01)
for step in range(60):
    loss = (picture(shift) - wanted).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 10 == 0:
        print(f"step {step:2d}: loss {loss.item():.5f}, {shift.detach().norm():.3f} m away")
pictures = torch.cat([first, picture(shift).detach(), wanted], dim=1)
write_image(chosen.output, np.clip(pictures.numpy(), 0, 1))
print(f"from {distance:.3f} m to {shift.detach().norm():.3f} m: {chosen.output}")

"""Arguments of the examples, and a scene and a light made by formulas for those who give none.

A red ball and a metal ring on a chequered floor, under a low sun; z is up, lengths are metres.
"""

import argparse
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.gaussians import GaussianScene
from tron.gaussians.harmonics import rgb_to_dc
from tron.gaussians.scene import quats_from_normals
from tron.relighting import EnvironmentMap
from tron.runtime import activate
from tron.trajectories import plan_cameras

FLOOR, BALL, RING = 1, 2, 3
OUTPUTS = Path("outputs/examples")


INPUTS = {
    "scene": "your PLY; default: a ball and a ring, made here",
    "environment": "your HDRI (.hdr, .exr); default: a low sun",
    "dataset": "made by examples.make_dataset or tron-datagen; default: %(default)s",
    "renderer": "trained by examples.train or tron-train; default: %(default)s",
}


def arguments(description: str | None, output: str, **inputs: Path | None) -> argparse.Namespace:
    """Read the command line and start the renderer.

    Args:
        description: of the example.
        output: where it writes within outputs/examples, unless told otherwise.
        inputs: of INPUTS and their defaults; scene and environment where none is named.
    """
    parser = argparse.ArgumentParser(description=description)
    for name, default in (inputs or {"scene": None, "environment": None}).items():
        parser.add_argument(f"--{name}", type=Path, default=default, help=INPUTS[name])
    parser.add_argument("--output", type=Path, default=OUTPUTS / output, help="default: %(default)s")
    parser.add_argument("--small", action="store_true", help="few pixels, surfels and steps: for tests")
    chosen = parser.parse_args()
    activate()
    return chosen


def load_scene(chosen: argparse.Namespace) -> GaussianScene:
    """The user's scene turned to z up, or the one made here."""
    if chosen.scene is None:
        return make_scene(0.08 if chosen.small else 0.02)
    scene = GaussianScene.load(chosen.scene)
    return scene.upright()


def load_light(chosen: argparse.Namespace) -> EnvironmentMap:
    """The user's environment map, or the one made here."""
    return make_light() if chosen.environment is None else EnvironmentMap.load(chosen.environment)


def look_at(scene: GaussianScene, chosen: argparse.Namespace, frames: int = 1) -> list[Camera]:
    """Cameras on an orbit around the scene."""
    width, height = (96, 64) if chosen.small else (768, 512)
    return plan_cameras(scene, "orbit", frames, width=width, height=height, fov_deg=40)


def make_scene(spacing: float) -> GaussianScene:
    """Surfels about `spacing` apart."""
    side = np.arange(-1.5, 1.5, spacing)
    floor = np.stack([*np.meshgrid(side, side), np.zeros((len(side), len(side)))], axis=-1).reshape(-1, 3)
    tiles = (np.floor(floor[:, :1] / 0.25) + np.floor(floor[:, 1:2] / 0.25)) % 2
    count = int(4 * np.pi * 0.4**2 / spacing**2)
    z, turn = 1 - (2 * np.arange(count) + 1) / count, np.pi * (3 - 5**0.5) * np.arange(count)
    ball = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    around, across = np.arange(0, 2 * np.pi, spacing / 0.5), np.arange(0, 2 * np.pi, spacing / 0.13)
    a, b = (each.ravel() for each in np.meshgrid(around, across))
    across_ring = np.array([-0.5, 0.87, 0])  # the ring stands upright and faces the first camera aslant
    outward = np.cos(a)[:, None] * across_ring + np.sin(a)[:, None] * [0, 0, 1]
    ring = np.cos(b)[:, None] * outward + np.sin(b)[:, None] * [0.87, 0.5, 0]
    ring_centre = [-0.1, 0.5, 0.5] + 0.37 * outward

    means = np.concatenate([floor, [0.1, -0.4, 0.4] + 0.4 * ball, ring_centre + 0.13 * ring])
    normals = np.concatenate([np.broadcast_to([0.0, 0.0, 1.0], floor.shape), ball, ring])
    which = np.repeat([FLOOR, BALL, RING], [len(floor), len(ball), len(ring)])
    color = np.concatenate(
        [0.12 + 0.5 * tiles * [1, 1, 1], np.tile([0.75, 0.08, 0.05], (len(ball), 1)),
         np.tile([0.95, 0.7, 0.35], (len(ring), 1))]
    )  # fmt: skip
    sh = np.zeros((len(means), 16, 3))
    sh[:, 0] = rgb_to_dc(color)
    return GaussianScene(
        means=means,
        quats=quats_from_normals(normals),
        log_scales=np.full((len(means), 2), np.log(0.5 * spacing)),
        opacity_logits=np.full(len(means), 4.6),
        sh=sh,
        base_color=color,
        roughness=np.choose(which - FLOOR, [0.6, 0.3, 0.12]),
        metallic=(which == RING).astype(float),
        object_id=which,
        kernel_degree=4,
        spacing=spacing,
    ).validate()


def make_light(height: int = 128) -> EnvironmentMap:
    """A blue sky over brown ground with a warm sun, linear radiance (height, 2 height, 3)."""
    polar = np.pi * np.arange(height)[:, None] / (height - 1)
    azimuth = np.pi * (np.arange(2 * height)[None] + 0.5) / height
    level = np.sin(polar)
    towards = np.stack([level * np.sin(azimuth), level * np.cos(azimuth), np.cos(polar) + 0 * azimuth], -1)
    up = towards[..., 2:]
    sky = np.where(up > 0, [0.9, 1.0, 1.1] - np.maximum(up, 0) ** 0.5 * [0.7, 0.6, 0.35], [0.3, 0.26, 0.22])
    sun = np.array([0.5, -0.7, 0.51])
    within = np.clip((towards @ sun - np.cos(0.09)) / 0.001, 0, 1)[..., None]
    return EnvironmentMap((sky + within * [150.0, 115.0, 75.0]).astype(np.float32))

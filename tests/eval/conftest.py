"""A drawn world for the benchmarks: a ball on a floor under one light, every buffer a closed formula."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import MATERIAL
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.schema import TARGET, Clip, ClipMeta, clip_members, light_members
from tron.shards.writer import ShardWriter

LIGHTS = {"noon": "sun", "softbox": "studio", "grey": "overcast", "dusk": "sun", "window": "studio"}


def draw_frame(size: int, seed: int, light: str, frame: int = 0) -> dict[str, np.ndarray]:
    """Members of one frame, (size, size, C) float32: linear colours, an elliptic shadow, a sky behind."""
    rng = generator(seed, "drawn", light)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    azimuth = rng.uniform(-1, 1) + 0.1 * frame
    sun, sky = {"sun": (2.0, 0.25), "studio": (1.2, 0.4), "overcast": (0.25, 0.8)}[LIGHTS[light]]
    centre = np.array([0.3 * np.sin(seed), 0.05])
    u, v = (x - centre[0]) / 0.42, (y - centre[1]) / 0.42
    ball = u**2 + v**2 < 1
    floor = (y > 0.1) & ~ball
    normal = np.stack([u, np.sqrt(np.clip(1 - u**2 - v**2, 0, 1)), -v], -1)  # x right, y near, z up
    normal[floor] = (0, 0.3, 0.954)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    to_light = np.array([np.sin(azimuth), 0.5, 0.8])
    cosine = np.clip(normal @ (to_light / np.linalg.norm(to_light)), 0, 1)[..., None]
    shadow = ((x - centre[0] + 0.5 * np.sin(azimuth)) / 0.5) ** 2 + ((y - 0.52) / 0.16) ** 2 < 1
    visible = np.where(floor & shadow, 0.0, 1.0)[..., None]
    colours = rng.uniform(0.1, 0.9, (3, 3))
    checks = ((np.floor(x * 4) + np.floor(y * 4)) % 2)[..., None]
    base = np.where(ball[..., None], colours[0], colours[1] * checks + colours[2] * (1 - checks))
    tint = np.array([1.0, 0.93, 0.85])
    unshadowed = (sky + sun * cosine) * tint
    irradiance = (sky * (0.5 + 0.5 * visible) + sun * cosine * visible) * tint
    gloss = 0.6 * np.clip(cosine, 0, 1) ** 40 * sun
    backdrop = np.broadcast_to(sky * np.array([0.8, 0.9, 1.1]) * (1.2 - 0.4 * y)[..., None], base.shape)
    solid = (ball | floor)[..., None]

    def over(image: np.ndarray) -> np.ndarray:
        return np.where(solid, image, backdrop).astype(np.float32)

    noise = generator(seed, "noise", light, frame)
    drawn = {
        "pbr": over(base * unshadowed + gloss),
        "irradiance": over(irradiance),
        "rgb": over(base * irradiance * (1 + 0.25 * base) + gloss * visible),
        "unshadowed": over(unshadowed),
        "shadowed": over(base * irradiance + gloss),
        "lit": over(base * irradiance * (1 + 0.2 * base) + gloss),
        "albedo": np.where(solid, np.clip(base, 0, 1), 0).astype(np.float32),
        "surface": np.where(solid, np.abs(normal[..., 1:2]) * [1, 0.4, 0.4], 0).astype(np.float32),
        "mask": solid.astype(np.float32),
        "foreground": solid.astype(np.float32),
        "sampling": np.broadcast_to(np.array([0, 0.6, 0.5], np.float32), base.shape),
        "lit_supersampled": over(base * irradiance * (1 + 0.22 * base) + gloss),
        "lit_reflections": over(base * irradiance * (1 + 0.24 * base) + gloss * visible),
        "irradiance_ref": over(irradiance * (1 + 0.05 * noise.standard_normal(irradiance.shape))),
        "unshadowed_ref": over(unshadowed),
        "base_color_ref": np.where(solid, base, 0).astype(np.float32),
        "normal_ref": np.where(solid, normal, 0).astype(np.float32),
        "base_color": np.where(solid, np.clip(base + 0.02, 0, 1), 0).astype(np.float32),
        "normal": np.where(solid, normal, 0).astype(np.float32),
        "depth_ref": np.where(solid[..., 0], 4 - y, 0).astype(np.float32),
        "depth": np.where(solid[..., 0], 4 - y + 0.01, 0).astype(np.float32),
        "roughness_ref": np.where(solid[..., 0], 0.4, 0).astype(np.float32),
        "roughness": np.where(solid[..., 0], 0.45, 0).astype(np.float32),
        "metallic_ref": np.where(ball, 0.5, 0).astype(np.float32),
        "metallic": np.where(ball, 0.48, 0).astype(np.float32),
    }
    return drawn | {name: drawn["pbr"] for name in light_members() if name not in drawn}


def describe_clip(key: str, split: str, scene: str, light: str, frames: int, size: int) -> ClipMeta:
    cameras = [
        Camera.look_at((np.sin(0.1 * k), -4, 1), (0, 0, 0), fov_deg=35, width=size, height=size)
        for k in range(frames)
    ]
    return ClipMeta(
        key=key,
        scene=scene,
        light=light,
        light_family=LIGHTS[light],  # type: ignore[arg-type]
        split=split,
        frames=frames,
        width=size,
        height=size,
        cameras=[camera.to_dict() for camera in cameras],
        exposure=0.4,
        color_space=dict.fromkeys((*light_members(), TARGET), "linear"),
    )


@pytest.fixture(scope="session")
def drawn_clip() -> Callable[..., Clip]:
    """A clip in memory: drawn_clip(light="noon", seed=0, frames=2, size=32)."""

    def make(light: str = "noon", seed: int = 0, frames: int = 2, size: int = 32) -> Clip:
        drawn = [draw_frame(size, seed, light, k) for k in range(frames)]
        meta = describe_clip(f"s{seed:06d}-{light}", "test", f"s{seed:06d}", light, frames, size)
        members = {name: np.stack([frame[name] for frame in drawn]) for name in drawn[0]}
        return Clip(meta, {n: m[..., None] if m.ndim == 3 else m for n, m in members.items()})

    return make


@pytest.fixture(scope="session")
def write_dataset() -> Callable[..., Path]:
    """Write a data set: write_dataset(folder, size=32, frames=2); train, train_b and test splits.

    judged: name of the last one, such as test_relit. noise: share of the truth's radiance.
    """

    def write(
        folder: Path,
        size: int = 32,
        frames: int = 2,
        scenes: int = 2,
        judged: str = "test",
        noise: float = 0.0,
    ) -> Path:
        entries = []
        for split, first, lights, count in (
            ("train", 0, ("noon", "softbox", "grey"), 1),
            ("train_b", 20, ("noon",), 1),
            (judged, 10, ("dusk", "window", "grey"), frames),
        ):
            with ShardWriter(folder, split, samples_per_shard=4) as writer:
                for seed in range(first, first + scenes):
                    for light in lights:
                        meta = describe_clip(
                            f"s{seed:06d}-{light}", split, f"s{seed:06d}", light, count, size
                        )
                        members = [draw_frame(size, seed, light, k) for k in range(count)]
                        for frame in members if noise else ():
                            rng = generator(seed, "drawn", "truth", light)
                            frame[TARGET] = frame[TARGET] * np.float32(
                                1 + noise * rng.standard_normal(frame[TARGET].shape)
                            )
                        if split != judged:
                            members = [_without_references(frame) for frame in members]
                        writer.write(meta, members)
            entries += writer.entries
        Manifest(config_sha256="0" * 64, shards=entries, material=MATERIAL).save(folder)
        return folder

    return write


def _without_references(frame: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: frame[name] for name in clip_members(reference=False)}


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory, write_dataset: Callable[..., Path]) -> Path:
    """A small data set on disk, shared by the tests that only read it."""
    return write_dataset(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained weights: tiny and pixel_mlp, which return lit, and those of two buffers, which return pbr."""
    from tron.neural.configs import PAPER_GUIDANCE, PixelMLPConfig, RendererConfig
    from tron.neural.networks.pixel_mlp import PixelMLP
    from tron.neural.renderer import NeuralRenderer
    from tron.neural.weights import save_renderer

    folder = tmp_path_factory.mktemp("weights")
    save_renderer(folder / "tiny.safetensors", NeuralRenderer())
    save_renderer(folder / "pixel_mlp.safetensors", PixelMLP())
    two = {"guidance": PAPER_GUIDANCE}
    save_renderer(folder / "tiny_of_two.safetensors", NeuralRenderer(RendererConfig.model_validate(two)))
    save_renderer(folder / "pixel_mlp_of_two.safetensors", PixelMLP(PixelMLPConfig.model_validate(two)))
    return folder


@pytest.fixture(scope="session")
def write_drawn_suite() -> Callable[..., Path]:
    """Write a suite of drawn scenes: write_drawn_suite(folder, scenes=2, frames=2, size=32).

    Scenes are those of draw_frame by their seeds, under noon and dusk; truth is its rgb.
    """
    from eval.protocol.suite import MapName, NewScene, write_suite
    from tron.captures import Capture, View
    from tron.captures.folder import write_capture
    from tron.shading.environments.environment import EnvironmentMap

    def write(
        folder: Path,
        scenes: int = 2,
        frames: int = 2,
        size: int = 32,
        background: Literal["black", "environment"] = "environment",
    ) -> Path:
        def scene(seed: int) -> NewScene:
            drawn = {
                light: [draw_frame(size, seed, light, k) for k in range(frames)] for light in ("noon", "dusk")
            }
            cameras = [
                Camera.from_dict(each)
                for each in describe_clip("k", "test", "s", "noon", frames, size).cameras
            ]
            photos = [
                View(
                    f"v{k}", camera, np.clip(frame["rgb"], 0, 1), "display", mask=frame["foreground"][..., 0]
                )
                for k, (camera, frame) in enumerate(zip(cameras, drawn["noon"]))
            ]
            lights = {
                f"{number}_{light}": (
                    EnvironmentMap.constant(1.0 + seed),
                    0.4,
                    LIGHTS[light],
                    np.stack([frame["rgb"] for frame in drawn[light]]),
                )
                for number, light in enumerate(drawn, 1)
            }
            maps: dict[MapName, np.ndarray] = {
                "mask": np.stack([frame["foreground"][..., 0] for frame in drawn["noon"]]),
                "albedo": np.stack([frame["base_color_ref"] for frame in drawn["noon"]]),
                "normals": np.stack([frame["normal_ref"] for frame in drawn["noon"]]),
                "depth": np.stack([frame["depth_ref"] for frame in drawn["noon"]]),
            }
            return NewScene(
                f"drawn-{seed:06d}",
                "table" if seed % 2 else "object",
                lambda path: write_capture(path, Capture(tuple(photos))),
                EnvironmentMap.constant(1.0),
                cameras,
                lights,
                maps,
            )

        return write_suite(folder, "drawn", map(scene, range(scenes)), background=background).folder

    return write


@pytest.fixture(scope="session")
def drawn_suite(tmp_path_factory: pytest.TempPathFactory, write_drawn_suite: Callable[..., Path]) -> Path:
    """A suite of two drawn scenes, shared by the tests that only read it."""
    return write_drawn_suite(tmp_path_factory.mktemp("suites") / "drawn")

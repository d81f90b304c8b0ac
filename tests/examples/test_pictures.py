"""Every script of a committed picture runs, small, on data made here."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tron.cameras import Camera
from tron.estimation import MATERIAL
from tron.gaussians import GaussianScene
from tron.io.images import read_image, write_image
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.schema import MEMBERS, TARGET, ClipMeta, clip_members, light_members
from tron.shards.writer import ShardWriter

PICTURES = Path(__file__).resolve().parents[2] / "dev" / "pictures"
SCRIPTS = sorted(path.name for path in PICTURES.glob("*.py"))


def run(name: str, *arguments: str | Path) -> None:
    """Start a script as its first lines say."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(PICTURES.parents[1]), *sys.path]))
    }
    command = [sys.executable, name, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=PICTURES, env=environment)
    assert done.returncode == 0, done.stderr


def drawn_split(folder: Path, split: str, clips: dict[str, int], size: int) -> None:
    """A split of random buffers: key of a clip -> its frames."""
    rng = generator(0, "test", "pictures", split)
    with ShardWriter(folder, split, samples_per_shard=4) as writer:
        for key, frames in clips.items():
            view = {"target": (0, 0, 0), "fov_deg": 35, "width": size, "height": size}
            cameras = [Camera.look_at((0.01 * k, -4, 1), **view) for k in range(frames)]
            meta = ClipMeta(
                key=key, scene=key[:11], light="sun", light_family="sun", split=split, frames=frames,
                width=size, height=size, cameras=[camera.to_dict() for camera in cameras], exposure=0.4,
                color_space=dict.fromkeys((*light_members(), TARGET), "linear"),
            )  # fmt: skip
            writer.write(meta, [frame(rng, size) for _ in range(frames)])
    Manifest(config_sha256="0" * 64, shards=writer.entries, material=MATERIAL).save(folder)


def frame(rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
    members = {}
    for name in clip_members(reference=True):
        shape = (size, size, 3) if MEMBERS[name].channels == 3 else (size, size)
        members[name] = rng.uniform(0.1, 1, shape).astype(np.float32)
    return members


def pictures(*paths: Path) -> None:
    """They are there, and are not blank."""
    for path in paths:
        assert read_image(path).std() > 0.01, path


@pytest.mark.long
def test_relit_models(tmp_path: Path):
    for name in ("FlightHelmet/FlightHelmet.gltf", "cat/cat.glb", "spot/spot.obj"):
        (tmp_path / "assets" / name).parent.mkdir(parents=True)
        trimesh.creation.box().export(tmp_path / "assets" / name)
    (tmp_path / "hdri").mkdir()
    sky = np.linspace(0.2, 2, 16 * 32 * 3).reshape(16, 32, 3).astype(np.float32)
    write_image(tmp_path / "hdri" / "venice_sunset_1k.hdr", sky)
    run("relit_models.py", "--small", tmp_path, tmp_path / "a.jpg", tmp_path / "b.jpg")
    pictures(tmp_path / "a.jpg", tmp_path / "b.jpg")


@pytest.mark.long
def test_guidance_limits(tmp_path: Path):
    run("guidance_limits.py", "--small", tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


@pytest.mark.long
def test_tron_synth(tmp_path: Path):
    run("tron_synth.py", "--small", tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


@pytest.mark.long
def test_demo(tmp_path: Path):
    from tron.neural.configs import PAPER_GUIDANCE, RendererConfig
    from tron.neural.renderer import NeuralRenderer
    from tron.neural.weights import save_renderer

    clips = {"test-000000-l1": 3, "test-000001-l0": 3, "test-000002-l2": 3}
    drawn_split(tmp_path / "dataset", "test", clips, 32)
    for name, guidance in (("unet", None), ("unet_of_two", PAPER_GUIDANCE)):
        config = RendererConfig() if guidance is None else RendererConfig(guidance=guidance)
        (tmp_path / "train" / name).mkdir(parents=True)
        save_renderer(tmp_path / "train" / name / "renderer.safetensors", NeuralRenderer(config))
    run("demo.py", tmp_path, tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


@pytest.mark.long
def test_renderer(tmp_path: Path):
    drawn_split(tmp_path, "test", {"test-000001-l1": 1, "test-000001-l0": 1}, 512)
    run("renderer.py", tmp_path, tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


@pytest.mark.long
def test_photographs(variant, tmp_path: Path):
    from datagen.cli import cli

    words = [
        *("experiment=photographs", "mode=captures", "capture.scenes=1", "capture.views=9", "cluster=none"),
        *("capture.width=24", "capture.height=24", "capture.path_spp=4", "capture.reference_spp=4"),
        *("capture.relight_spp=4", "environment_height=32", f"output_dir={tmp_path / 'photographs'}"),
    ]
    with pytest.raises(SystemExit) as end:
        cli(words)
    assert end.value.code == 0
    rng, count = generator(0, "test", "surfels"), 200
    scene = GaussianScene(
        means=rng.uniform(-1, 1, (count, 3)),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 2), np.log(0.1)),
        opacity_logits=np.full(count, 4.0),
        sh=np.zeros((count, 16, 3)),
        base_color=np.full((count, 3), 0.5),
        roughness=np.full(count, 0.5),
        metallic=np.zeros(count),
        object_id=np.zeros(count),
        kernel_degree=4,
        spacing=0.1,
    )
    for capture in (tmp_path / "photographs" / "captures").glob("test-*"):
        folder = tmp_path / "scenes" / capture.name / "photos"
        folder.mkdir(parents=True)
        scene.save(folder / "scene.ply")
    run("photographs.py", tmp_path, tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


@pytest.mark.long
@pytest.mark.skipif(
    "TRON_BLENDER_PYTHON" not in os.environ, reason="TRON_BLENDER_PYTHON names no Python that has bpy"
)
def test_blender(shared_data: Path, tmp_path: Path):
    run("blender.py", shared_data, Path(os.environ["TRON_BLENDER_PYTHON"]), tmp_path / "a.jpg")
    pictures(tmp_path / "a.jpg")


def test_the_zoos_wall_is_made_smaller(tmp_path):
    (tmp_path / "pictures").mkdir()
    write_image(tmp_path / "pictures" / "wall.png", np.full((200, 2300, 3), 0.5, np.float32))
    run("zoo.py", tmp_path, tmp_path / "zoo.jpg")
    assert read_image(tmp_path / "zoo.jpg").shape == (100, 1150, 3)


def test_every_script_of_a_picture_is_run():
    tested = re.findall(r'run\("(\w+\.py)"', Path(__file__).read_text())
    assert sorted(tested) == SCRIPTS

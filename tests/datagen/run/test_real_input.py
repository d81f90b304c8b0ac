"""Real models and real light through the whole engine: path-traced, made surfels, relit by another map."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen.run.dataset import make
from datagen.settings.command import Settings
from datagen.world.scene import SceneSpec
from tron import metrics
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance
from tron.shards.reader import read_clips
from tron.tracing import SurfelTracer

MODELS = ("FlightHelmet/FlightHelmet.gltf", "GolfBall/GolfBall.glb", "spot/spot.obj")
LICENCES = ("CC0-1.0", "test data only", "public domain")

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def dataset(shared_data: Path, variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    maps = sorted(path.name for path in (shared_data / "hdri").glob("*.hdr"))
    missing = [name for name in MODELS if not (shared_data / "assets" / name).is_file()]
    if missing or len(maps) < 4:
        pytest.skip(f"no real data: {', '.join(missing) or 'environment maps'} absent from {shared_data}")
    folder = tmp_path_factory.mktemp("real")
    for model in MODELS:  # the folder may hold others, of which this test knows no licence
        kept = Path(model).parent
        shutil.copytree(shared_data / "assets" / kept, folder / "assets" / kept)
    catalogue = folder / "catalogue.json"
    entries = [{"path": path, "licence": licence} for path, licence in zip(MODELS, LICENCES)]
    entries += [{"path": name, "licence": "CC0-1.0", "source": "Poly Haven"} for name in maps]
    catalogue.write_text(json.dumps(entries))
    overrides = [
        f"output_dir={folder / 'dataset'}",
        f"assets={folder / 'assets'}",
        f"environments={shared_data / 'hdri'}",
        f"catalogue={catalogue}",
        "seed=4",
        "cluster=none",
        "objects=[5,5]",
        "train.scenes=1",
        "train.lights=[any]",
        "train_b.scenes=0",
        "validation.scenes=0",
        "test.scenes=1",
        "test.lights=[hdri,hdri]",
        "views=24",
        "view_width=160",
        "view_height=160",
        "surfels=30000",
        "environment_height=64",
        "path_frames=24",
        *(f"{split}.{key}" for split in ("train", "test") for key in ("frames=2", "width=96", "height=96")),
        *(f"{split}.path_spp=16" for split in ("train", "test")),
    ]
    assert make(check(compose_recipe("conf.datagen", Settings, overrides), Settings)) == 0
    return folder / "dataset"


def test_the_models_stand_in_the_scenes_and_in_the_card(dataset: Path):
    specs = [SceneSpec.model_validate_json(path.read_bytes()) for path in dataset.glob("scenes/*/spec.json")]
    used = {item.asset for spec in specs for item in spec.objects}
    assert used == {"FlightHelmet", "GolfBall", "spot"}
    card = (dataset / "README.md").read_text()
    for licence in LICENCES:
        assert licence in card


def test_lights_of_the_test_split_are_held_out(dataset: Path):
    lights = {
        split: {
            json.loads(clip.meta.extra["light_spec"])["path"]
            for clip in read_clips(dataset, split, members=["mask"])
        }
        for split in ("train", "test")
    }
    assert not lights["train"] & lights["test"]


def test_surfels_of_real_models_look_like_them(dataset: Path):
    for clip in read_clips(dataset, "test"):
        frames = clip.frames
        for k, seen in enumerate(frames["foreground"][..., 0] > 0.5):
            assert metrics.psnr(frames["base_color"][k], frames["base_color_ref"][k], seen) >= 20
            assert metrics.angular_error_deg(frames["normal"][k], frames["normal_ref"][k], seen) <= 12
            assert frames["mask"][k, ..., 0][seen].mean() > 0.95


def test_another_map_relights_them_and_shows_behind_them(dataset: Path, shared_data: Path):
    clip = next(iter(read_clips(dataset, "test")))
    surfels = GaussianScene.load(dataset / "scenes" / clip.meta.scene / "surfels.ply")
    camera = Camera.from_dict(clip.meta.cameras[0])
    environment = EnvironmentMap.load(shared_data / "hdri" / "venice_sunset_1k.hdr").resized(64)
    guidance = render_guidance(SurfelTracer(surfels), camera, Lighting(environment), Estimation(rays=16))
    for image in (guidance.pbr, guidance.irradiance, guidance.shadowed):
        assert np.isfinite(image).all()
        assert image.min() >= 0
    empty = guidance.mask.reshape(96, 96) < 1e-3
    np.testing.assert_allclose(
        guidance.pbr[empty], environment.lookup(camera.rays())[empty], rtol=0.02, atol=1e-3
    )
    assert (
        np.abs(guidance.irradiance - clip.frames["irradiance"][0]).mean() > 0.05 * guidance.irradiance.mean()
    )

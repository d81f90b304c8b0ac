"""A network of one's own through tron-train: refused before step 1, or trained, resumed and read again."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from train.cli import cli, main
from train.settings import Settings
from tron.errors import TronError
from tron.neural.configs import GuidedConfig
from tron.neural.protocols import Renderer
from tron.neural.weights import load_renderer
from tron.storage import sha256

OWN = Path(__file__).resolve().parents[2] / "examples/own_network"
STAGES = [
    {"name": "one", "split": "train", "steps": 4, "batch_size": 2, "crop": 16},
    {"name": "two", "split": "train_b", "frames": 5, "steps": 4, "batch_size": 1, "crop": 16},
]


class Broken(Renderer):
    """Wrong in the way that a test asks for."""

    wrong = "size"

    def __init__(self, config: GuidedConfig | None = None):
        super().__init__()
        self.config = config or GuidedConfig()
        self.scale = torch.nn.Parameter(torch.ones(1))

    def forward(self, buffers, weights=None):
        drawn = self.scale * buffers[self.config.skip]
        return {
            "size": drawn[..., :-1],
            "NaN": drawn / 0,
            "gradient": drawn.detach(),
            "none": None,
        }[self.wrong]


@pytest.fixture
def own(make_settings, dataset, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(OWN)
    recipe = cli.compose("dataset=x", "output_dir=y").renderer  # the default's; none of it leaks
    assert "backbone" not in recipe

    def settings(output: str, **changes) -> Settings:
        recipe = {"_target_": "dilated.net.Dilated", "config": {"width": 4}}
        changes = {"renderer": recipe, "stages": STAGES, "validation": {"split": None}} | changes
        return Settings.model_validate(make_settings(dataset, tmp_path / output, **changes))

    yield settings
    for name in ("dilated", "dilated.net"):
        sys.modules.pop(name, None)


def test_it_is_trained_through_all_stages_and_resumes_to_the_byte(own, monkeypatch, tmp_path):
    main(own("whole"))
    whole = load_renderer(tmp_path / "whole/renderer.safetensors")
    assert type(whole).__name__ == "Dilated"
    assert whole.config.width == 4  # type: ignore[attr-defined]

    from train import run

    ended = run._end_stage
    monkeypatch.setattr(
        run, "_end_stage", lambda *args: (ended(*args), (_ for _ in ()).throw(KeyboardInterrupt))
    )
    with pytest.raises(KeyboardInterrupt):
        main(own("halves"))
    assert not (tmp_path / "halves/renderer.safetensors").exists()
    monkeypatch.setattr(run, "_end_stage", ended)
    main(own("halves"))
    first, second = ((tmp_path / name / "renderer.safetensors").read_bytes() for name in ("whole", "halves"))
    assert first == second
    assert load_file(tmp_path / "whole/renderer.safetensors")["layers.8.weight"].abs().sum() > 0


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("size", "returns"),
        ("NaN", "NaN or infinity"),
        ("gradient", "without gradients"),
        ("none", "NoneType"),
    ],
)
def test_what_it_draws_is_looked_at_before_step_1(own, wrong, said, monkeypatch, tmp_path):
    monkeypatch.setattr(Broken, "wrong", wrong)
    with pytest.raises(TronError, match=said):
        main(own("out", renderer={"_target_": f"{__name__}.Broken"}))
    assert not list((tmp_path / "out").glob("checkpoints/*"))


def test_settings_of_another_class_are_refused(own):
    config = {"_target_": "tron.neural.configs.UNetRendererConfig"}
    with pytest.raises(TronError, match="takes settings of DilatedConfig, not UNetRendererConfig"):
        main(own("out", renderer={"_target_": "dilated.net.Dilated", "config": config}))


def test_a_setting_that_it_has_not_is_refused_by_name(own):
    with pytest.raises(TronError, match=r"renderer\.config\.widht"):
        main(own("out", renderer={"_target_": "dilated.net.Dilated", "config": {"widht": 3}}))


@pytest.mark.long
def test_the_example_is_installed_trained_killed_resumed_and_drawn_with(make_settings, dataset, tmp_path):
    """As its page says, by commands alone, with pip."""
    site, programs = tmp_path / "site", Path(sys.executable).parent
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        site,
    ]
    shutil.copytree(OWN, tmp_path / "package")  # setuptools builds where the sources are
    subprocess.run([*pip, str(tmp_path / "package")], check=True)
    beside = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *filter(None, sys.path)])}
    stage = "[{name: one, split: train, steps: 20, batch_size: 2, crop: 16}]"
    train = [
        *(programs / "tron-train", "--config-dir", OWN / "recipes", "renderer=dilated", f"dataset={dataset}"),
        *(
            f"stages={stage}",
            "validation.split=null",
            "checkpoint_every=4",
            "accelerator=cpu",
            "loss.lpips=0",
        ),
    ]
    subprocess.run([*train, f"output_dir={tmp_path / 'whole'}"], env=beside, check=True)

    killed = subprocess.Popen([*train, f"output_dir={tmp_path / 'killed'}"], env=beside)
    checkpoints = tmp_path / "killed/checkpoints"
    while killed.poll() is None and not list(checkpoints.glob("1-one-????????.ckpt")):
        time.sleep(0.02)
    killed.kill()
    assert killed.wait() == -9
    again = [*train, f"output_dir={tmp_path / 'killed'}"]
    done = subprocess.run(again, env=beside, check=True, capture_output=True, text=True)
    assert "from step" in done.stderr
    weights = tmp_path / "killed/renderer.safetensors"
    assert sha256(weights) == sha256(tmp_path / "whole/renderer.safetensors")

    from examples.stage import make_light, make_scene
    from tron.io.images import read_image

    make_scene(0.08).save(tmp_path / "scene.ply")
    make_light().save(tmp_path / "light.exr")
    relight = [
        *(
            programs / "tron-relight",
            f"scene={tmp_path / 'scene.ply'}",
            f"environment={tmp_path / 'light.exr'}",
        ),
        *(f"checkpoint={weights}", "frames=1", "width=32", "height=32", "trajectory=still"),
    ]
    subprocess.run([*relight, f"output_dir={tmp_path / 'drawn'}"], env=beside, check=True)
    drawn = read_image(tmp_path / "drawn/frames/0000.neural.png")
    assert drawn.shape[:2] == (32, 32)
    assert np.ptp(drawn) > 0.05

    alone = subprocess.run([*relight, f"output_dir={tmp_path / 'refused'}"], capture_output=True, text=True)
    assert alone.returncode == 2
    assert "dilated.net:Dilated, a network that no installed package declares" in alone.stderr

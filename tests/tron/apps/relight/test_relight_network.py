"""The network of tron-relight: where it comes from, what is tuned at it, when it gives way or is refused."""

import json
import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tron.apps.relight.clip import Clip
from tron.apps.relight.settings import Settings
from tron.io.images import read_image
from tron.neural import network_gains, shipped
from tron.neural.configs import PAPER_GUIDANCE, RendererConfig, UNetConfig
from tron.neural.renderer import NeuralRenderer
from tron.neural.weights import save_renderer
from tron.storage import sha256

GAINS = {
    "network": {"preview": {16: 2.0, 64: -0.1}, "final": {128: -0.4}},
    "oidn": {"preview": {16: 0.0}, "final": {128: 0.0}},
}
"""In place of those that were measured, which change with the shipped network."""
SMALL = UNetConfig(widths=(4, 6), blocks=(1, 1), blocks_up=(1,))


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder of networks that change the picture a little, called as the shipped ones are."""
    folder = tmp_path_factory.mktemp("shipped")
    for name, guidance in (("paper", PAPER_GUIDANCE), ("surfaces", ("pbr", "irradiance", "lit"))):
        torch.manual_seed(0)
        config = RendererConfig(guidance=guidance, window=3, codec="pixels", fusion="average", backbone=SMALL)
        renderer = NeuralRenderer(config)
        for parameter in renderer.parameters():
            torch.nn.init.normal_(parameter, std=0.3)
        save_renderer(folder / f"{name}.safetensors", renderer)
    return folder


@pytest.fixture
def run(relight, scene_path, light_path):
    """Films three small frames into a folder with these settings; gives the exit code."""

    def film(out, *settings: str) -> int:
        base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=3"]
        return relight(*base, "width=16", "height=16", *settings)

    return film


def pictures(out, name: str = "relit") -> np.ndarray:
    return np.stack([read_image(out / "frames" / f"{index:04d}.{name}.png") for index in range(3)])


@pytest.mark.long
def test_window_overlap_and_weights_change_the_pictures_and_are_on_record(run, checkpoints, tmp_path):
    path, drawn = checkpoints / "paper.safetensors", {}
    choices = {
        "plain": (),
        "single": ("window=1",),
        "mean": ("overlap=mean", "window=2"),
        "in_place": ("reproject=1",),
        "weighed": ("weights={pbr: 0.3, irradiance: 0.7}",),
        "equal": ("weights={pbr: 0.5, irradiance: 0.5}",),
    }
    for name, settings in choices.items():
        # The traced frames stay: what they are made of does not depend on the network.
        assert run(tmp_path, f"checkpoint={path}", *settings) == 0
        drawn[name] = pictures(tmp_path)
        report = json.loads((tmp_path / "relight.json").read_text())
        network = report["network"]
        assert report["frames_rendered"] == (3 if name == "plain" else 0)
        assert network["window"] == {"single": 1, "mean": 2}.get(name, 3)
        assert network["overlap"] == ("mean" if name == "mean" else "anchor")
        assert network["reproject"] == (1 if name == "in_place" else 3), "of three frames"
        assert network["guidance"] == ["pbr", "irradiance"]
        if name == "weighed":
            assert network["weights"] == {"pbr": 0.3, "irradiance": 0.7}
    np.testing.assert_array_equal(drawn["equal"], drawn["plain"])
    for name in ("single", "mean", "weighed", "in_place"):
        assert np.abs(drawn[name] - drawn["plain"]).max() > 2 / 255


@pytest.mark.long
def test_frames_of_an_older_run_that_lack_a_buffer_are_traced_again_with_a_line(
    run, checkpoints, tmp_path, caplog
):
    path = checkpoints / "paper.safetensors"
    assert run(tmp_path, f"checkpoint={path}") == 0
    for old in (tmp_path / "frames").glob("*.depth.exr"):
        old.unlink()
    caplog.clear()
    assert run(tmp_path, f"checkpoint={path}") == 0
    assert "frames that have no depth yet are traced again" in caplog.text
    assert json.loads((tmp_path / "relight.json").read_text())["frames_rendered"] == 3


def test_a_run_without_the_network_leaves_no_pictures_of_one_before(run, checkpoints, tmp_path):
    assert run(tmp_path, f"checkpoint={checkpoints / 'paper.safetensors'}") == 0
    neural = [tmp_path / "neural.mp4", *(tmp_path / "frames").glob("*.neural.png")]
    assert len(neural) == 4
    assert all(path.exists() for path in neural)
    assert run(tmp_path, "checkpoint=null") == 0
    assert not any(path.exists() for path in neural)
    assert (tmp_path / "relit.mp4").exists()


def test_one_frame_is_not_said_to_be_averaged(relight, scene_path, light_path, checkpoints, tmp_path):
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path}", "frames=1"]
    assert relight(*base, f"checkpoint={checkpoints / 'paper.safetensors'}", "width=16", "height=16") == 0
    assert json.loads((tmp_path / "relight.json").read_text())["network"]["reproject"] == 1


def test_the_record_is_of_the_file_that_was_loaded(run, checkpoints, tmp_path, monkeypatch):
    """A training may write the next checkpoint in its place while frames are drawn."""
    path, draw = Path(shutil.copy(checkpoints / "paper.safetensors", tmp_path)), Clip.draw

    def drawn(*arguments):
        path.write_bytes(b"the next one")
        draw(*arguments)

    monkeypatch.setattr(Clip, "draw", drawn)
    assert run(tmp_path / "out", f"checkpoint={path}") == 0
    network = json.loads((tmp_path / "out" / "relight.json").read_text())["network"]
    assert network["sha256"] == sha256(checkpoints / "paper.safetensors")


def test_a_shipped_checkpoint_is_given_by_name(run, checkpoints, tmp_path, monkeypatch, capsys):
    assert run(tmp_path / "path", f"checkpoint={checkpoints / 'paper.safetensors'}") == 0
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    assert run(tmp_path / "name", "checkpoint=paper") == 0
    np.testing.assert_array_equal(pictures(tmp_path / "name"), pictures(tmp_path / "path"))
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    assert run(tmp_path / "absent", "checkpoint=paper") == 2
    error = capsys.readouterr().err.strip()
    assert "this installation has no checkpoint 'paper'" in error
    assert "\n" not in error
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("bounces=0",), "no bounced light with bounces=0"),
        (("fidelity=paper",), "no bounced light with bounces=0"),
        (("buffers=[relit]",), "buffers ask for relit.exr"),
        (
            ("quality=final",),
            "surfaces gains nothing for sure: -0.40 dB at least on validation scenes, final at 16 x 16",
        ),
        (("supersample=2",), "final at 16 x 16"),
        (("reflections=2",), "final at 16 x 16"),
        (("width=64", "height=64"), "-0.10 dB at least on validation scenes, preview at 64 x 64"),
        ((), "this installation has no checkpoint 'surfaces'"),
    ],
)
def test_the_default_checkpoint_gives_way_where_it_does_not_fit(
    run, checkpoints, tmp_path, monkeypatch, caplog, settings, words
):
    monkeypatch.setattr(shipped, "FOLDER", checkpoints if settings else tmp_path)
    monkeypatch.setattr(network_gains, "GAINS", GAINS)
    with caplog.at_level("INFO"):
        assert run(tmp_path / "out", "checkpoint=auto", "frames=1", *settings) == 0
    assert words in caplog.text
    report = json.loads((tmp_path / "out" / "relight.json").read_text())
    direct = settings in (("bounces=0",), ("fidelity=paper",))
    assert report["relit"] == ("shadowed" if direct else "lit")
    assert report["network"] is None
    assert not list((tmp_path / "out" / "frames").glob("*.neural.png"))


def test_the_default_checkpoint_does_not_give_way_where_something_is_asked_of_it(
    run, checkpoints, tmp_path, monkeypatch, capsys
):
    """Pictures without a network are no answer to a choice of its weights."""
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    assert run(tmp_path / "out", "checkpoint=auto", "weights={pbr: 1, irradiance: 1}") == 2
    assert "weights lack 'lit'" in capsys.readouterr().err
    assert run(tmp_path / "out", "checkpoint=auto", "window=5", "buffers=[relit]") == 2
    assert not (tmp_path / "out").exists()


def test_the_default_checkpoint_draws_where_it_gains_and_says_so(
    run, checkpoints, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    monkeypatch.setattr(network_gains, "GAINS", GAINS)
    with caplog.at_level("INFO"):
        assert run(tmp_path, "checkpoint=auto") == 0
    assert (
        "surfaces draws the pictures: +2.00 dB at least on validation scenes, preview at 16 x 16"
        in caplog.text
    )
    report = json.loads((tmp_path / "relight.json").read_text())
    assert report["relit"] == "neural"
    assert report["network"]["checkpoint"] == "surfaces"


CLOSER = {
    "network": {"preview": {16: 2.0}, "final": {16: 0.3}},
    "oidn": {"preview": {16: 0.5}, "final": {16: 0.45}},
}


@pytest.mark.parametrize(
    ("settings", "relit", "words"),
    [
        (
            (),
            "neural",
            "surfaces draws the pictures: +2.00 dB at least on validation scenes, preview at 16 x 16",
        ),
        ((), "neural", "preview at 16 x 16; Open Image Denoise +0.50"),
        (
            ("quality=final",),
            "denoised",
            "Open Image Denoise draws the pictures: +0.45 dB at least on validation scenes, final at 16 x 16"
            "; surfaces +0.30",
        ),
        (("buffers=[relit]",), "plain", "buffers ask for relit.exr"),
        (("quality=final", "denoise=false"), "neural", "surfaces draws the pictures: +0.30 dB"),
        (("quality=final", "reproject=1"), "neural", "surfaces draws the pictures: +0.30 dB"),
        (("bounces=0",), "plain", "no bounced light with bounces=0"),
    ],
)
def test_auto_takes_what_gains_most_and_says_by_how_much(
    run, checkpoints, tmp_path, monkeypatch, caplog, settings, relit, words
):
    """Open Image Denoise has no say: nothing bounces, noise or radiance is asked for, a network is tuned."""
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    monkeypatch.setattr(network_gains, "GAINS", CLOSER)
    with caplog.at_level("INFO"):
        assert run(tmp_path, "checkpoint=auto", "frames=1", *settings) == 0
    assert words in caplog.text
    report = json.loads((tmp_path / "relight.json").read_text())
    assert (report["relit"] == "neural") == (relit == "neural")
    assert (report["settings"]["denoise"] == "oidn") == (relit == "denoised")
    assert ("through Open Image Denoise" in caplog.text) == (relit == "denoised")


def test_auto_goes_without_a_denoiser_that_is_not_installed(run, checkpoints, tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    monkeypatch.setattr(network_gains, "GAINS", CLOSER)
    with caplog.at_level("INFO"):
        assert run(tmp_path, "checkpoint=auto", "quality=final", "frames=1") == 0
    assert "surfaces draws the pictures: +0.30 dB" in caplog.text
    assert "Open Image Denoise" not in caplog.text


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("bounces=0",), "no bounced light with bounces=0"),
        (("buffers=[relit]",), "no relit.exr with a checkpoint"),
    ],
)
def test_a_shipped_checkpoint_that_was_asked_for_is_taken_or_refused(
    run, checkpoints, tmp_path, monkeypatch, capsys, settings, words
):
    monkeypatch.setattr(shipped, "FOLDER", checkpoints)
    assert run(tmp_path / "final", "checkpoint=surfaces", "quality=final", "bounces=1") == 0
    assert json.loads((tmp_path / "final" / "relight.json").read_text())["relit"] == "neural"
    assert run(tmp_path / "out", "checkpoint=surfaces", *settings) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_default_is_a_shipped_one_whose_file_is_there():
    assert Settings.model_fields["checkpoint"].default == Path(shipped.AUTO)
    assert shipped.shipped(shipped.DEFAULT).is_file()


class _Explosive:
    def __reduce__(self):
        return (print, ("executed",))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("weights={pbr: 1, lit: 1}",), "weights name 'lit': the network is given pbr, irradiance"),
        (("weights={pbr: 1}",), "weights lack 'irradiance'"),
        (("checkpoint=pickle.safetensors",), "not a readable safetensors file"),
        (("checkpoint=weights.pt",), "not a readable safetensors file"),
        (("checkpoint=foreign.safetensors",), "holds no TRON renderer"),
        (("checkpoint=unknown.safetensors",), "guidance is one or more of pbr"),
        (("checkpoint=dct.safetensors", "window=3"), "1 + 4n"),
    ],
)
def test_networks_that_do_not_fit_are_one_line_before_any_frame(
    run, checkpoints, tmp_path, monkeypatch, capsys, settings, words
):
    from safetensors.torch import save_file

    monkeypatch.chdir(tmp_path)
    shutil.copy(checkpoints / "paper.safetensors", tmp_path)
    (tmp_path / "pickle.safetensors").write_bytes(pickle.dumps(_Explosive()))
    torch.save({"net.x": _Explosive()}, tmp_path / "weights.pt")
    save_file({"x": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    header = {"format": "tron-renderer 1", "kind": "neural", "config": {"guidance": ["pbr", "thickness"]}}
    save_file({"x": torch.zeros(1)}, tmp_path / "unknown.safetensors", {"tron": json.dumps(header)})
    save_renderer(tmp_path / "dct.safetensors", NeuralRenderer(RendererConfig(backbone=SMALL)))
    given = settings if settings[0].startswith("checkpoint=") else ("checkpoint=paper.safetensors", *settings)
    assert run(tmp_path / "out", *given) == 2
    captured = capsys.readouterr()
    error = captured.err.strip()
    assert words in error
    assert given[0].removeprefix("checkpoint=") in error
    assert "\n" not in error
    assert "executed" not in captured.out + captured.err
    assert not (tmp_path / "out").exists()

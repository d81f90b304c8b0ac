"""denoise=oidn of the command, from its message without the library to the files that it writes."""

import json
import sys

import numpy as np
import pytest

from tron.denoising import DENOISERS, Denoiser
from tron.io.images import read_image
from tron.neural import network_gains


@pytest.fixture
def base(scene_path, light_path) -> list[str]:
    return [f"scene={scene_path}", f"environment={light_path}", "frames=1"]


def test_without_the_library_it_is_refused_in_one_line(relight, base, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert relight(*base, "denoise=oidn", f"output_dir={tmp_path / 'out'}") == 2
    error = capsys.readouterr().err.strip()
    assert error == "tron-relight: denoise=oidn needs pyoidn: pip install 'tron-relight[oidn]'"
    assert not (tmp_path / "out").exists()


def test_a_network_and_the_denoiser_are_one_too_many(relight, base, tmp_path, capsys):
    out = f"output_dir={tmp_path / 'out'}"
    assert relight(*base, "denoise=oidn", "checkpoint=surfaces", out) == 2
    assert "would both draw the picture" in capsys.readouterr().err
    assert relight(*base, "denoise=intel", out) == 2
    assert "true, false or a denoiser: oidn" in capsys.readouterr().err


def test_the_relit_picture_alone_is_denoised(relight, base, tmp_path, capsys):
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    base = [*base, "checkpoint=null", "width=48", "height=24", "exposure=1"]
    for name, given in {"raw": "true", "clean": "oidn", "again": "oidn"}.items():
        assert relight(*base, f"denoise={given}", f"output_dir={tmp_path / name}") == 0
    frames = {name: tmp_path / name / "frames" for name in ("raw", "clean", "again")}
    changed = set()
    for path in sorted(frames["raw"].glob("*.exr")):
        clean, again = (frames[name] / path.name for name in ("clean", "again"))
        assert clean.read_bytes() == again.read_bytes()
        if not np.array_equal(read_image(path), read_image(clean)):
            changed.add(path.name.split(".")[1])
    assert changed == {"lit", "foreground"}
    report = json.loads((tmp_path / "clean" / "relight.json").read_text())
    assert (report["relit"], report["settings"]["denoise"]) == ("lit", "oidn")
    # Frames of the two are never mixed.
    assert relight(*base, "denoise=oidn", f"output_dir={tmp_path / 'raw'}") == 2
    assert "denoise=True, not oidn" in capsys.readouterr().err
    assert relight(*base, f"output_dir={tmp_path / 'clean'}") == 2
    assert "denoise=oidn, not True" in capsys.readouterr().err


def test_the_default_checkpoint_gives_way(relight, base, tmp_path, caplog):
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    with caplog.at_level("INFO"):
        assert relight(*base, "denoise=oidn", f"output_dir={tmp_path}", "background=transparent") == 0
    assert "No network: denoise=oidn draws the pictures" in caplog.text
    assert "through Open Image Denoise" in caplog.text
    assert read_image(tmp_path / "frames" / "0000.relit.png", channels=4).shape[2] == 4
    assert not (tmp_path / "neural.mp4").exists()


def test_a_rival_is_a_row(relight, base, tmp_path, monkeypatch, caplog):
    """Half the light, darker where surfaces turn from up: the frame's own buffers say how much."""

    def half(lit, normal, albedo):
        return lit * 0.25 * (1 + normal[..., 2:]) * (albedo.max(-1, keepdims=True) > 0)

    row = Denoiser("Half", "half of it", ("normal", "albedo"), "numpy", "pip install numpy", lambda: half)
    monkeypatch.setitem(DENOISERS, "half", row)
    base = [*base, "width=16", "height=16", "exposure=1", "buffers=[lit,normal,foreground,mask]"]
    frames = {name: tmp_path / name / "frames" for name in ("raw", "half", "auto")}
    gains = {"network": {"preview": {16: -1.0}}, "half": {"preview": {16: 0.5}}}
    monkeypatch.setattr(network_gains, "GAINS", gains)
    chosen = {"raw": "checkpoint=null", "half": "denoise=half", "auto": "checkpoint=auto"}
    with caplog.at_level("INFO"):
        for name, given in chosen.items():
            assert relight(*base, given, f"output_dir={tmp_path / name}") == 0
    assert "Half draws the pictures: +0.50 dB" in caplog.text
    assert "through Half" in caplog.text
    read = {
        run: {
            name: read_image(frames[run] / f"0000.{name}.exr")
            for name in ("lit", "normal", "foreground", "mask")
        }
        for run in frames
    }
    solid = read["raw"]["mask"][..., 0] > 0.999
    assert solid.sum() > 20
    for run in ("half", "auto"):
        expected = read["raw"]["lit"] * 0.25 * (1 + read["raw"]["normal"][..., 2:])
        np.testing.assert_allclose(read[run]["lit"][solid], expected[solid], rtol=0.01, atol=1e-3)
        np.testing.assert_array_equal(read[run]["normal"], read["raw"]["normal"])
    report = json.loads((tmp_path / "auto" / "relight.json").read_text())
    assert report["settings"]["denoise"] == "half"

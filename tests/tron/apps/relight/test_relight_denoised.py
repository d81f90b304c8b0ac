"""denoise=oidn of the command, from its message without the library to the files that it writes."""

import json
import sys

import numpy as np
import pytest

from tron.io.images import read_image


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
    assert "'denoise" in capsys.readouterr().err


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
    assert "denoise=oidn, not None" in capsys.readouterr().err


def test_the_default_checkpoint_gives_way(relight, base, tmp_path, caplog):
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    with caplog.at_level("INFO"):
        assert relight(*base, "denoise=oidn", f"output_dir={tmp_path}", "background=transparent") == 0
    assert "No network: denoise=oidn draws the pictures" in caplog.text
    assert "through Open Image Denoise" in caplog.text
    assert read_image(tmp_path / "frames" / "0000.relit.png", channels=4).shape[2] == 4
    assert not (tmp_path / "neural.mp4").exists()

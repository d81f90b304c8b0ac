"""An opened scan: Python and every command light the same thing, with its materials, proxy and ground."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.tron.apps.conftest import SIZE
from tron.apps import view
from tron.apps.bake import Settings as BakeSettings
from tron.apps.edit import Settings as EditSettings
from tron.apps.relight.settings import Settings as RelightSettings
from tron.estimation import QUALITY
from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.io.images import read_image
from tron.relighting import EnvironmentMap
from tron.relighting.ground import Ground
from tron.relighting.proxy import Proxy, make_proxy
from tron.scans import Scan, materials
from tron.tracing import SurfelTracer
from tron.trajectories import plan_cameras
from tron.view.stage import Stage, Wish

FRAME = ("frames=1", "checkpoint=null", "buffers=[lit,mask]", "threads=1")
VIEW = {"width": SIZE, "height": SIZE, "fov_deg": 40.0}


@pytest.fixture
def asked(variant, monkeypatch) -> list[int]:
    """How often materials were looked for; a rough green, and a proxy of it, are found."""
    found = []

    def carry(capture, settings, seed, track):
        found.append(1)
        scan, count = capture.scan, len(capture.scan)
        green = np.tile(np.array([0.1, 0.6, 0.1], np.float32), (count, 1))
        values = {"base_color": green, "roughness": np.full(count, 0.7, np.float32)}
        scene = replace(scan, **values, metallic=np.zeros(count, np.float32), materials_guessed=False)
        proxy = make_proxy(SurfelTracer(scene), [each.camera for each in capture.views])
        return None if proxy is None else SimpleNamespace(scene=scene, proxy=proxy.painted(scene))

    monkeypatch.setattr("tron.reconstruction.materials.carried.carry_materials", carry)
    monkeypatch.setattr(materials, "VIEWS", 12)
    monkeypatch.setattr(materials, "SIDE", 32)
    return found


@pytest.fixture(params=["plain.ply", "packed.spz", "own.ply"])
def file(request, ball_on_floor, tmp_path) -> Path:
    """A ball without a floor: splats as other programs have them, y down; or a scene of ours."""
    scene, path = ball_on_floor(0.08), tmp_path / request.param
    ball = subset(scene, scene.object_id == 1)
    if request.param == "own.ply":
        ball.save(path)
    else:
        write_splats(path, ball.rotated(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])))
        if path.suffix == ".ply":
            path.write_bytes(re.sub(rb"comment tron [^\n]*\n", b"", path.read_bytes()))
    return path


def test_python_and_the_command_draw_the_same_pixels(asked, file, light_path, relight, tmp_path, caplog):
    """Of a scan that was never opened before, and of what is kept beside it then."""
    words = (f"scene={file}", f"environment={light_path}", f"output_dir={tmp_path / 'out'}", "rotation=30")
    assert relight(*words, *FRAME) == 0
    theirs = read_image(tmp_path / "out" / "frames" / "0000.lit.exr")
    scan = Scan.open(file)
    (camera,) = plan_cameras(scan.content, "orbit", 1, **VIEW)
    frame = scan.under(light_path, rotation=30).render(camera)
    np.testing.assert_array_equal(frame.lit.astype(np.float16), theirs)  # EXRs are of half floats
    assert isinstance(scan.ground([camera]), Ground)
    plain = file.name != "own.ply"
    assert len(asked) == plain
    assert plain == (
        file.with_suffix(".materials.ply").is_file() and file.with_suffix(".proxy.ply").is_file()
    )
    assert not scan.scene.materials_guessed
    assert ("does not say which way is up" in caplog.text) == plain


def test_the_finest_quality_is_the_same_too(asked, ball_on_floor, light_path, relight, tmp_path):
    ball_on_floor(0.1).save(tmp_path / "own.ply")
    words = (f"scene={tmp_path / 'own.ply'}", f"environment={light_path}", f"output_dir={tmp_path / 'out'}")
    assert relight(*words, *FRAME, "quality=final") == 0
    scan = Scan.open(tmp_path / "own.ply")
    (camera,) = plan_cameras(scan.content, "orbit", 1, **VIEW)
    frame = scan.under(EnvironmentMap.load(light_path), QUALITY["final"]).render(camera)
    np.testing.assert_array_equal(
        frame.lit.astype(np.float16), read_image(tmp_path / "out" / "frames" / "0000.lit.exr")
    )


@pytest.mark.parametrize("file", ["plain.ply"], indirect=True)
def test_the_viewer_at_rest_has_the_surfels_of_a_preview_and_its_ground(asked, file, light_path):
    scan = Scan.open(file, key="")
    (camera,) = plan_cameras(scan.content, "orbit", 1, **VIEW)
    stage = Stage(
        scan.in_file, {"lamp": EnvironmentMap.load(light_path)}, camera, scan.root, about=scan.about()
    )
    stage.bring(Wish("lamp"), rough=False)
    (part,) = stage.parts(Wish("lamp"), camera)
    seen = stage.linear(part, camera)["lit"]
    frame = scan.under(light_path).render(camera)
    whole = frame.mask > 0.999
    assert whole.mean() > 0.2
    np.testing.assert_array_equal(seen[whole], frame.lit[whole])
    bare = Stage(scan.in_file, {"lamp": EnvironmentMap.load(light_path)}, camera, scan.root)
    bare.bring(Wish("lamp"), rough=False)
    below = (frame.mask == 0) & (camera.rays()[..., 2] < 0)
    bared = bare.linear(part, camera)["lit"]
    assert np.abs(seen - bared)[below].mean() > 2 * np.abs(seen - frame.lit)[below].mean() > 0


@pytest.mark.parametrize("file", ["plain.ply"], indirect=True)
def test_a_baked_and_an_edited_scan_have_the_materials_of_a_relit_one(asked, file, light_path, tmp_path):
    """The first command that wants them finds them; what they write says nothing of guesses."""
    from tron.apps import bake, edit

    (tmp_path / "edits.yaml").write_text("- {action: move, select: {object: 0}, by: [0, 0, 1]}")
    edit.main(
        EditSettings.model_validate(
            {"scene": file, "edits": tmp_path / "edits.yaml", "output": tmp_path / "edited.ply"}
        )
    )
    edited = GaussianScene.load(tmp_path / "edited.ply")
    assert not edited.materials_guessed
    np.testing.assert_array_equal(edited.base_color[:, 1], np.float32(0.6))
    np.testing.assert_allclose(edited.means, GaussianScene.load(file).means + np.array([0, 0, 1]), atol=1e-6)
    bake.main(
        BakeSettings.model_validate(
            {"scene": file, "environment": light_path, "output": tmp_path / "baked.ply"}
        )
    )
    assert asked == [1]
    red, green, _ = np.median(GaussianScene.load(tmp_path / "baked.ply").sh[:, 0], axis=0)
    assert green > red
    as_is = {"scene": file, "materials": "as_is"}
    edit.main(EditSettings(**as_is, edits=tmp_path / "edits.yaml", output=tmp_path / "as_is.ply"))
    assert GaussianScene.load(tmp_path / "as_is.ply").materials_guessed


def test_all_commands_have_one_default():
    """Of each setting of how a scan is opened, where a command has it; but a window opens at once."""
    models = (RelightSettings, BakeSettings, EditSettings, view.Settings)
    for name in ("materials", "ground", "surroundings", "projection", "up"):
        asked = [each for each in models if (each, name) != (view.Settings, "materials")]
        found = [each.model_fields[name] for each in asked if name in each.model_fields]
        assert len({(repr(field.default), field.description) for field in found}) == 1, name
    assert all("materials" in each.model_fields for each in models)
    assert view.Settings.model_fields["materials"].default == "kept"


def test_a_proxy_of_edits_does_not_replace_the_scans(asked, ball_on_floor, light_path, tmp_path):
    from tron.editing import Move, Selection

    scene = ball_on_floor(0.12)
    scene = replace(subset(scene, scene.object_id == 1), oriented=False)
    scene.save(tmp_path / "scan.ply")
    scan = Scan.open(tmp_path / "scan.ply")
    (camera,) = plan_cameras(scan.content, "orbit", 1, **VIEW)
    stage = Stage(
        scan.in_file, {"lamp": EnvironmentMap.load(light_path)}, camera, scan.root, about=scan.about()
    )
    stage.bring(Wish("lamp"), rough=False)
    kept = (tmp_path / "scan.proxy.ply").read_bytes()
    edits = (Move(select=Selection(object=1), by=(0, 0, 1)),)
    stage.bring(Wish("lamp", edits=edits), rough=False)
    assert (tmp_path / "scan.proxy.ply").read_bytes() == kept
    assert Proxy.load(tmp_path / "scan.proxy.ply", "another") is None

"""tron-relight from end to end on a tiny scene: files, laws of light, resuming, and mistakes."""

import json
import logging
from dataclasses import fields

import numpy as np
import plyfile
import pytest

from tron.apps.frame_folder import FrameFolder
from tron.apps.relight.clip import Clip
from tron.apps.relight.settings import BUFFERS, DEFAULT_BUFFERS, Settings
from tron.apps.relit import RelitPicture
from tron.cameras import Camera
from tron.color import to_display
from tron.estimation import Estimation
from tron.flow import surface_motion
from tron.gaussians.ply import MATERIAL_PROPERTIES
from tron.io.images import read_image
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance
from tron.shards.schema import GUIDANCE
from tron.tracing.surface import Surface

SIZE = 32


def test_writes_frames_videos_sheet_and_report(relight, scene_path, light_path, tmp_path, read_video):
    out = tmp_path / "out"
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=2"]
    assert relight(*base, "buffers=[normal,depth,mask]", "checkpoint=null") == 0
    frames = sorted(path.name for path in (out / "frames").iterdir())
    buffers = ("depth", "irradiance", "lit", "mask", "normal", "pbr")
    expected = [f"{i:04d}.{name}.exr" for i in range(2) for name in buffers]
    expected += [f"{i:04d}.{name}.png" for i in range(2) for name in ("irradiance", "pbr", "relit")]
    assert frames == sorted([*expected, "exposure.json", "settings.json"])
    assert read_video(out / "guidance.mp4").shape == (2, SIZE, 2 * SIZE, 3)
    assert read_video(out / "relit.mp4").shape == (2, SIZE, SIZE, 3)
    assert read_image(out / "contact_sheet.png").shape == (18 + 3 * (SIZE + 2), 110 + 2 * (SIZE + 2), 3)
    assert not (out / "neural.mp4").exists()
    report = json.loads((out / "relight.json").read_text())
    assert report["frames"] == report["frames_rendered"] == 2
    assert report["guidance_exposure"] == pytest.approx(EnvironmentMap.load(light_path).exposure())
    assert report["exposure"] == json.loads((out / "frames" / "exposure.json").read_text())["photograph"]
    assert report["scene"]["materials_guessed"] is False
    assert report["relit"] == "lit"

    normal, mask = (read_image(out / "frames" / f"0000.{name}.exr") for name in ("normal", "mask"))
    middle = normal[SIZE // 2, SIZE // 2]
    assert np.linalg.norm(middle) == pytest.approx(1, abs=0.01)
    assert middle[0] > 0.8  # the first camera of an orbit stands on +x and sees the ball's front
    assert mask[SIZE // 2, SIZE // 2, 0] > 0.95


def test_every_buffer_of_the_help_is_made_and_all_guidance_is_written_by_default():
    shaded = {"foreground", "share", "relit", "albedo", "surface", "sampling"}
    assert set(BUFFERS) <= {field.name for field in fields(Surface)} | set(Guidance.BUFFERS) | shaded
    assert set(Guidance.BUFFERS) <= set(DEFAULT_BUFFERS)
    assert all(name in (Settings.model_fields["buffers"].description or "") for name in BUFFERS)


def test_maps_of_surfaces_are_written_where_they_are_asked_for(relight, scene_path, light_path, tmp_path):
    """In the middle of the ball they are the G-buffer's; where no surfel is, nothing."""
    names = ("albedo", "surface", "base_color", "roughness")
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path / 'out'}"]
    assert relight(*base, "frames=1", "checkpoint=null", f"buffers=[{','.join(names)}]") == 0
    maps = {name: read_image(tmp_path / "out" / "frames" / f"0000.{name}.exr") for name in names}
    middle = {name: image[SIZE // 2, SIZE // 2] for name, image in maps.items()}
    np.testing.assert_allclose(middle["albedo"], middle["base_color"], atol=0.03)
    assert middle["surface"][0] > 0.8
    assert middle["surface"][1] == pytest.approx(middle["roughness"][0], abs=0.03)
    assert not maps["albedo"][0, 0].any()


def test_the_papers_fidelity_gives_other_frames(relight, scene_path, light_path, tmp_path):
    """Plain sums of a few rays without a filter are noise where the filtered ratio is smooth."""
    shots = {}
    for name, chosen in (("ours", []), ("paper", ["fidelity=paper"])):
        base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path / name}"]
        assert relight(*base, "frames=1", *chosen) == 0
        shots[name] = read_image(tmp_path / name / "frames" / "0000.irradiance.exr")
        record = json.loads((tmp_path / name / "frames" / "settings.json").read_text())
        assert (record["estimator"], record["two_sided"]) == (("plain", False) if chosen else ("ratio", True))
    steps = {name: np.abs(np.diff(image, axis=1)).mean() for name, image in shots.items()}
    assert steps["paper"] > 1.5 * steps["ours"]


@pytest.mark.long
def test_rotating_light_and_camera_together_changes_nothing_else(
    relight, orbit_of_four, scene_path, light_path, tmp_path
):
    """Frame 1 of four in an orbit is 90 degrees on: under light turned by 90 it is frame 0 again."""
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path}", "frames=4"]
    assert relight(*base, "rotation=90", "quality=final") == 0
    first = read_image(orbit_of_four / "frames" / "0000.irradiance.exr")
    turned = [read_image(tmp_path / "frames" / f"{i:04d}.irradiance.exr") for i in range(2)]
    # The ball is a surface of revolution about +z up to its surfels; the square floor has this symmetry
    # exactly.
    assert np.abs(turned[1] - first).mean() < 0.3 * np.abs(turned[0] - first).mean()


def test_the_side_towards_the_lamp_is_bright_and_a_shadow_falls_behind(orbit_of_four):
    toward, left, away = (
        read_image(orbit_of_four / "frames" / f"{i:04d}.irradiance.exr").mean(axis=2) for i in range(3)
    )
    ball = slice(SIZE // 2 - 2, SIZE // 2 + 2)
    assert toward[ball, ball].mean() > 3 * away[ball, ball].mean()
    # From +y the lamp at +x is on the left (x axis points left), so the left half of the ball is brighter.
    assert left[ball, : SIZE // 2].mean() > 1.2 * left[ball, SIZE // 2 :].mean()
    # The lamp stands 38 degrees high on +x: the ball's shadow lies on the floor towards -x.
    camera = Camera.from_dict(json.loads((orbit_of_four / "relight.json").read_text())["cameras"][1])
    pixels, _ = camera.project(np.array([[0.7, 0, 0], [-0.7, 0, 0]]))
    lit, shaded = (left[int(y), int(x)] for x, y in pixels)
    assert lit > 2 * shaded


def test_a_second_run_renders_nothing_and_only_lost_frames_come_back(
    relight, scene_path, light_path, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=2"]
    assert relight(*base) == 0
    files = sorted((out / "frames").glob("*.exr"))
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}
    with monkeypatch.context() as patch:
        patch.setattr(BounceTransport, "trace", None)
        assert relight(*base, "exposure=0.1") == 0
    assert json.loads((out / "relight.json").read_text())["frames_rendered"] == 0
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files} == before
    lost = out / "frames" / "0001.pbr.exr"
    lost.unlink()
    assert relight(*base) == 0
    assert json.loads((out / "relight.json").read_text())["frames_rendered"] == 1
    assert lost.read_bytes() == before[lost][1]


def test_other_settings_in_the_same_folder_are_refused(relight, scene_path, light_path, tmp_path, capsys):
    out = tmp_path / "out"
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=1"]
    assert relight(*base) == 0
    assert relight(*base, "rotation=45") == 2
    assert "rotation=0.0, not 45.0" in capsys.readouterr().err
    for setting in ("bounces=1", "reflections=2", "supersample=2", "brdf=lambert"):
        assert relight(*base, setting) == 2
        assert f"{setting.split('=')[0]}=" in capsys.readouterr().err
    assert relight(*base, "rotation=45", "overwrite=true") == 0


@pytest.mark.long
def test_a_plain_3dgs_file_is_relit_with_a_warning(
    relight, scene_path, light_path, tmp_path, caplog, monkeypatch
):
    """Without materials, and with normals of random sign, as 3DGS writes them."""
    rows = plyfile.PlyData.read(str(scene_path))["vertex"].data
    names = [name for name in rows.dtype.names if name not in (*MATERIAL_PROPERTIES, "object_id")]
    plain = np.empty(len(rows), [(name, "<f4") for name in names])
    for name in names:
        plain[name] = rows[name]
    w, x, y, z = (plain[f"rot_{k}"][::2].copy() for k in range(4))  # half of the surfels turned over
    for k, turned in enumerate((-x, w, z, -y)):
        plain[f"rot_{k}"][::2] = turned
    path = tmp_path / "plain.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(plain, "vertex")], byte_order="<").write(str(path))
    masks = []
    caplog.set_level("INFO")
    monkeypatch.setattr("tron.relighting.proxy.VIEWS", 24)
    for scene, out in ((scene_path, tmp_path / "ours"), (path, tmp_path / "plain")):
        base = [f"scene={scene}", f"environment={light_path}", f"output_dir={out}", "frames=1"]
        assert relight(*base, "up=[0,0,1]", "materials=as_is") == 0
        masks.append(read_image(out / "frames" / "0000.mask.exr")[..., 0])
    assert "materials" in caplog.text
    assert "guessed" in caplog.text
    assert json.loads((tmp_path / "plain" / "relight.json").read_text())["scene"]["materials_guessed"] is True
    # Whichever way its normals point, the surface is there; kernel degree 2 is softer than the scene's 4.
    assert np.abs(masks[0] - masks[1]).mean() < 0.1
    assert "which way is up" not in caplog.text
    assert not scene_path.with_suffix(".proxy.ply").exists()
    assert (tmp_path / "plain.proxy.ply").is_file()
    assert "filming a proxy for light: 0 of 24" in caplog.messages
    assert any("normals have no sign: light sees a proxy of" in line for line in caplog.messages)
    caplog.clear()
    base = [f"scene={path}", f"environment={light_path}", "frames=1", "up=[0,0,1]", "materials=as_is"]
    assert relight(*base, f"output_dir={tmp_path / 'kept'}") == 0
    assert any("light sees the proxy of" in line for line in caplog.messages)
    caplog.clear()
    assert relight(*base, f"output_dir={tmp_path / 'never'}", "proxy=never") == 0
    assert "proxy=never: light sees the scan itself" in caplog.messages
    silent = tmp_path / "silent"
    assert relight(*base[:3], *base[4:], f"output_dir={silent}") == 0
    assert "does not say which way is up: -y is taken" in caplog.text
    assert json.loads((silent / "frames" / "settings.json").read_text())["up"] == [0, -1, 0]


def test_each_part_of_a_run_names_itself_as_it_begins(relight, scene_path, light_path, tmp_path, caplog):
    """So that no silence is without a name, and what is done at once has one line."""
    with caplog.at_level(logging.INFO, "tron.cli.progress"):
        arguments = (f"scene={scene_path}", f"environment={light_path}", "frames=3", "checkpoint=null")
        assert relight(*arguments, f"output_dir={tmp_path}") == 0
    begun = ["reading the lights and the network", "reading the scene", "where light bounces: 0 of 8"]
    begun += ["guidance: 0 of 3", "light that bounces, baked", "videos and contact sheets"]
    assert [line for line in caplog.messages if line in begun] == begun
    assert not [line for line in caplog.messages if line.endswith("0:00 left")]


def test_a_new_renderer_is_given_lit_and_shows_it(relight, scene_path, light_path, tmp_path, read_video):
    """Untrained, a renderer gives back what it starts from; what is tested is the way there and back."""
    from tron.neural.configs import PixelMLPConfig
    from tron.neural.networks.pixel_mlp import PixelMLP
    from tron.neural.weights import save_renderer

    checkpoint, out = tmp_path / "renderer.safetensors", tmp_path / "out"
    save_renderer(checkpoint, PixelMLP(PixelMLPConfig(width=4)))
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=2"]
    assert relight(*base, f"checkpoint={checkpoint}", "reproject=1") == 0
    report = json.loads((out / "relight.json").read_text())
    for index in range(2):
        neural, lit, pbr = (
            read_image(out / "frames" / f"{index:04d}.{name}.png") for name in ("neural", "lit", "pbr")
        )
        np.testing.assert_allclose(neural, lit, atol=1.01 / 255)
        assert np.abs(lit - pbr).max() > 0.05
        radiance = read_image(out / "frames" / f"{index:04d}.lit.exr")
        exposed = to_display(radiance, report["exposure"], look="photograph")
        relit = read_image(out / "frames" / f"{index:04d}.relit.png")
        assert np.abs(relit - exposed).max() < 0.02
        assert np.abs(relit - neural).max() > 0.05  # the network draws under the exposure that it learnt with
    assert report["relit"] == "neural"
    assert read_video(out / "guidance.mp4").shape == (2, SIZE, 4 * SIZE, 3)
    assert read_video(out / "neural.mp4").shape == (2, SIZE, SIZE, 3)


def test_without_bounces_a_renderer_that_is_given_lit_is_refused(
    relight, scene_path, light_path, tmp_path, capsys
):
    """`lit` would be `shadowed` under another name; a renderer of pbr and irradiance is no worse off."""
    from tron.neural.configs import PixelMLPConfig
    from tron.neural.networks.pixel_mlp import PixelMLP
    from tron.neural.weights import save_renderer

    checkpoint, out = tmp_path / "renderer.safetensors", tmp_path / "out"
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", "frames=1", "bounces=0"]
    save_renderer(checkpoint, PixelMLP(PixelMLPConfig(width=4)))
    assert relight(*base, f"checkpoint={checkpoint}") == 2
    error = capsys.readouterr().err.strip()
    assert "no bounced light with bounces=0" in error
    assert "fidelity=paper" in error
    assert error.endswith("give bounces=4, or take a checkpoint of pbr and irradiance")
    assert "\n" not in error
    assert not out.exists()
    save_renderer(checkpoint, PixelMLP(PixelMLPConfig(width=4, guidance=("pbr", "irradiance"))))
    assert relight(*base, f"checkpoint={checkpoint}") == 0


def test_final_frames_without_bounces_have_no_reflections(tmp_path):
    """What a quality brings with it is no wish; asked for by name it would be refused."""
    given = {"scene": tmp_path, "environment": tmp_path, "output_dir": tmp_path, "quality": "final"}
    assert Settings(**given).estimation().reflections == 4
    assert Settings(**given, bounces=0).estimation().reflections == 0
    with pytest.raises(ValueError, match="reflections=2 would show light that bounces"):
        Estimation(bounces=0, reflections=2)


@pytest.mark.parametrize(("overlap", "reproject"), [("newest", 1), ("anchor", 5), ("newest", 5)])
def test_a_clip_from_disk_is_the_clip_in_memory(tmp_path, overlap, reproject):
    """In place, and averaged along the motion."""
    import torch

    from tron.neural.configs import BackboneConfig, RendererConfig
    from tron.neural.renderer import NeuralRenderer, render_clip

    small = BackboneConfig(heads=2, head_dim=12, layers=1, adaln_lora_dim=8)
    renderer = NeuralRenderer(RendererConfig(window=5, backbone=small)).eval()
    torch.manual_seed(1)
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    folder = FrameFolder(tmp_path, (*GUIDANCE, "depth"))
    rng = generator(0, "test", "clip")
    ground = np.where(np.arange(16)[:, None, None] < 6, 0, 5.0).repeat(16, 1)
    depths = [ground * (1 + 0.003 * index) for index in range(8)]
    for index in range(8):
        guidance = {name: rng.uniform(0, 2, (16, 16, 3)) for name in GUIDANCE}
        folder.write(index, {**guidance, "depth": depths[index]})
    places = [0.05 * k for k in range(8)]
    cameras = [Camera.look_at((x, -5, 0), (x, 0, 0), fov_deg=40, width=16, height=16) for x in places]
    motion = surface_motion(cameras, depths.__getitem__) if reproject > 1 else None
    light, picture = EnvironmentMap.constant(1.0), RelitPicture("environment", "neural")
    clip = Clip(light, [0.0] * 8, 0.7, picture, folder, chosen=0.7)
    clip.draw(renderer, overlap=overlap, cameras=cameras, reproject=reproject)
    linear = {name: np.stack([folder.read(i, name) for i in range(8)]) for name in GUIDANCE}
    shown = {name: to_display(buffer, 0.7) for name, buffer in linear.items()}
    whole = render_clip(renderer, shown, overlap=overlap, motion=motion)
    for index in range(8):
        np.testing.assert_allclose(folder.row(index, ["neural"]), whole[index], atol=1.01 / 255)


def test_motion_by_the_traced_depth_is_where_the_traced_position_is_seen(
    relight, scene_path, light_path, tmp_path
):
    base = [f"scene={scene_path}", f"environment={light_path}", "up=[0,0,1]", "frames=12"]
    assert relight(*base, f"output_dir={tmp_path}", "buffers=[depth,position]", "checkpoint=null") == 0
    folder = FrameFolder(tmp_path / "frames", ("depth", "position"))
    report = json.loads((tmp_path / "relight.json").read_text())
    cameras = [Camera.from_dict(each) for each in report["cameras"][:2]]
    motion = surface_motion(cameras, lambda k: folder.read(k, "depth")[..., 0])(0, 1)
    solid = folder.read(0, "depth")[..., 0] > 0
    there, _ = cameras[1].project(folder.read(0, "position")[solid])
    rows, columns = np.nonzero(solid)
    expected = there - np.stack([columns, rows], -1) - 0.5
    assert motion.seen[solid].mean() > 0.3
    np.testing.assert_allclose(motion.displacement[solid], expected, atol=1e-2)


@pytest.mark.long
def test_cameras_of_a_report_repeat_its_frames(relight, scene_path, light_path, tmp_path):
    base = [f"scene={scene_path}", f"environment={light_path}", "up=[0,1,1]", "frames=2"]
    assert relight(*base, f"output_dir={tmp_path / 'a'}") == 0
    assert relight(*base, f"output_dir={tmp_path / 'b'}", f"cameras={tmp_path / 'a' / 'relight.json'}") == 0
    for index in range(2):
        a, b = (read_image(tmp_path / run / "frames" / f"{index:04d}.mask.exr") for run in "ab")
        assert np.abs(a - b).mean() < 1e-3


@pytest.mark.long
def test_a_scene_lying_on_its_side_is_stood_up(relight, ball_on_floor, light_path, tmp_path):
    upright = ball_on_floor()
    lying = upright.rotated(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))  # up is now -y
    shots = []
    for name, scene in (("upright", upright), ("lying", lying)):
        path = tmp_path / f"{name}.ply"
        scene.save(path)
        base = [f"scene={path}", f"environment={light_path}", f"output_dir={tmp_path / name}", "frames=1"]
        assert relight(*base, "quality=final") == 0
        shots.append(read_image(tmp_path / name / "frames" / "0000.irradiance.exr"))
    assert np.abs(shots[0] - shots[1]).mean() < 0.05 * shots[0].mean()


def test_a_file_in_place_of_the_output_folder_is_one_line(relight, scene_path, light_path, tmp_path, capsys):
    (tmp_path / "out.mp4").write_text("kept")
    assert relight(f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path}/out.mp4") == 2
    assert "output_dir is a file" in capsys.readouterr().err
    assert (tmp_path / "out.mp4").read_text() == "kept"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scene": "absent.ply"}, "file not found (absent.ply)"),
        ({"environment": "absent.hdr"}, "absent.hdr"),
        ({"environment": "[a.hdr,b/a.hdr]"}, "a.hdr, b/a.hdr"),
        ({"vae": "absent.pth"}, "file not found (absent.pth)"),
        ({"checkpoint": "litt"}, "file not found (litt): checkpoints of the package are surfaces, paper"),
        ({"checkpoint": "absent.safetensors"}, "absent.safetensors"),
        ({"cameras": "absent.json"}, "absent.json"),
        ({"quality": "best"}, "'quality'"),
        ({"up": "[0,0,0]"}, "a direction has a length"),
        ({"exposure": "-1"}, "'exposure'"),
        ({"buffers": "pbr"}, "a list is written buffers=[pbr]"),
        ({"up": "0,0,1"}, "write 'up=[0,0,1]'"),
        ({"up": "[0,1]"}, "a list is written up=[0,0,1]"),
        ({"rotation": "fast"}, "a list is written rotation=[0,360]"),
        ({"rotation": "[0,x]"}, "'rotation.1'"),
        ({"background": "white"}, "a list is written background=[1,1,1]"),
        ({"background": "[0,0,255]"}, "'background.2' (255)"),
        ({"checkpoint": "absent.safetensors", "buffers": "[relit]"}, "no relit.exr with a checkpoint"),
        ({"window": "5", "checkpoint": "null"}, "window is the neural renderer's: give a checkpoint too"),
        ({"overlap": "mean", "checkpoint": "null"}, "overlap is the neural renderer's"),
        ({"overlap": "oldest", "checkpoint": "a.safetensors"}, "'overlap'"),
        ({"weights": "{pbr: -1}", "checkpoint": "a.safetensors"}, "the weight of 'pbr' is -1"),
        ({"weights": "{pbr: 0}", "checkpoint": "a.safetensors"}, "all weights are 0"),
        ({"weights": "0.5", "checkpoint": "a.safetensors"}, "'weights'"),
        ({"buffers": "[pbr,nonsense]"}, "'buffers"),
        ({"framse": "3"}, "framse"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    relight, scene_path, light_path, tmp_path, capsys, change, words
):
    options = {"scene": scene_path, "environment": light_path, "output_dir": tmp_path / "out"} | change
    assert relight(*(f"{key}={value}" for key, value in options.items())) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert error.startswith("tron-relight: ")
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_captures_own_light_stands_as_the_scene_does(
    relight, ball_on_floor, light_path, tmp_path, capsys
):
    """environment=capture of a scene whose up is y, beside the map of its world: as if both were z up."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z to y
    folder, light = tmp_path / "capture", EnvironmentMap.load(light_path).resized(128)
    folder.mkdir()
    ball_on_floor().rotated(turn).save(folder / "scene.ply")
    ball_on_floor().save(tmp_path / "upright.ply")
    light.save(tmp_path / "light.exr")
    given = [f"scene={folder / 'scene.ply'}", "environment=capture", "up=[0,1,0]", "frames=1", "exposure=1"]
    shot = ["buffers=[lit]", "background=[0,0,0]", "checkpoint=null"]
    assert relight(*given, *shot, f"output_dir={tmp_path / 'out'}") == 2
    assert "tron-reconstruct writes it beside its scene" in capsys.readouterr().err
    light.turned(turn).save(folder / "environment.exr")
    assert relight(*given, *shot, f"output_dir={tmp_path / 'out'}") == 0
    given[:3] = [f"scene={tmp_path / 'upright.ply'}", f"environment={tmp_path / 'light.exr'}"]
    assert relight(*given, *shot, f"output_dir={tmp_path / 'plain'}") == 0
    lit = [read_image(tmp_path / name / "frames" / "0000.lit.exr") for name in ("out", "plain")]
    # By another path it is the same file.
    given[:2] = [
        f"scene={folder / 'scene.ply'}",
        f"environment={folder / '..' / 'capture' / 'environment.exr'}",
    ]
    assert relight(*given, "up=[0,1,0]", *shot, f"output_dir={tmp_path / 'again'}") == 0
    np.testing.assert_allclose(read_image(tmp_path / "again" / "frames" / "0000.lit.exr"), lit[0], rtol=0.05)
    shown = [to_display(each, 0.3) for each in lit]
    assert -10 * np.log10(np.square(shown[0] - shown[1]).mean()) > 33

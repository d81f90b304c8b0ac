"""Laws of the relit picture, through the command: what it shows, over what, and in which light."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tron.apps.relight.settings import Settings
from tron.cameras import Camera
from tron.color import agx, from_agx, to_display
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.seeds import generator
from tron.shading.composition import background_share
from tron.shading.environments.environment import EnvironmentMap

SIZE = 32
STEP = 1.01 / 255
BACKGROUNDS = {"environment": "environment", "transparent": "transparent", "colour": "[0.2,0.9,0.4]"}


@pytest.fixture(scope="module")
def lights(tmp_path_factory) -> list[Path]:
    """Two skies of random texels, nothing in them alike."""
    folder = tmp_path_factory.mktemp("lights")
    for name in ("dawn", "night"):
        texels = generator(0, "tests", name).gamma(0.5, size=(16, 32, 3))
        EnvironmentMap(texels.astype(np.float32)).save(folder / f"{name}.exr")
    return [folder / "dawn.exr", folder / "night.exr"]


@pytest.fixture(scope="module")
def over(variant, scene_path, lights, tmp_path_factory):
    """One frame over each background: name -> folder of pictures."""
    from tron.apps.relight.cli import cli

    base = tmp_path_factory.mktemp("over")
    for name, background in BACKGROUNDS.items():
        with pytest.raises(SystemExit) as stop:
            cli([f"scene={scene_path}", f"environment={lights[0]}", f"output_dir={base / name}", "frames=1",
                 f"background={background}", f"width={SIZE}", f"height={SIZE}", f"variant={variant}",
                 "buffers=[relit,mask,foreground]"])  # fmt: skip
        assert stop.value.code == 0
    return base


def picture(folder: Path, name: str, index: int = 0, suffix: str = "png") -> np.ndarray:
    return read_image(folder / "frames" / f"{index:04d}.{name}.{suffix}", channels=None)


def directional_albedo(cosine: float, alpha: float, n: int = 400_000) -> float:
    """Share of light from everywhere that a GGX mirror of F0 = 0.04 sends to the eye.

    Half vectors drawn from D n.h, float64, Smith's masking for either side and Schlick's Fresnel; independent
    of tron.shading.
    """
    rng = generator(0, "tests", "albedo")
    u, phi = rng.random(n), rng.random(n) * 2 * np.pi
    z = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
    radius = np.sqrt(1 - z * z)
    half = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], 1)
    view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    along = half @ view
    down = 2 * along * z - cosine  # cosine of the mirrored direction
    fresnel = 0.04 + 0.96 * (1 - np.clip(along, 0, 1)) ** 5

    def masking(c: np.ndarray | float) -> np.ndarray:
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / np.square(c) - 1)))

    weight = fresnel * masking(np.maximum(down, 1e-9)) * masking(cosine) * along / (cosine * z)
    return float(np.where((down > 0) & (along > 0), weight, 0).mean())


@pytest.mark.parametrize(("exposure", "factor"), [("auto", None), ("0.7", 0.7)])
def test_a_white_surface_in_constant_light_shows_the_exposed_value(
    relight, dense_surfels, tmp_path, exposure, factor
):
    """Nothing in the way, base color 1, metallic 0: the diffuse part alone sends back the light's c exactly.

    What the dielectric coat adds is c times its reflectance, known here from an integral of its own.
    """
    light, roughness = np.array([0.5, 1.0, 2.0]), 0.5
    plane = dense_surfels.plane()
    white = np.ones((len(plane.points), 3))
    dense_surfels.scene(plane, base_color=white, roughness=white[:, 0] * roughness).save(tmp_path / "a.ply")
    EnvironmentMap.constant(light).save(tmp_path / "c.exr")
    view = Camera.look_at((0.5, -3, 1.2), (0, 0, 0), fov_deg=0.5, width=SIZE, height=SIZE)
    (tmp_path / "view.json").write_text(json.dumps([view.to_dict()]))
    out = tmp_path / "out"
    files = [f"scene={tmp_path / 'a.ply'}", f"environment={tmp_path / 'c.exr'}", f"output_dir={out}"]
    files += [f"cameras={tmp_path / 'view.json'}", "buffers=[relit]", "brdf=lambert"]
    assert relight(*files, f"exposure={exposure}") == 0
    luma = light @ (0.2126, 0.7152, 0.0722)
    shown = json.loads((out / "relight.json").read_text())["exposure"]
    # A white card in this light has radiance c; a white picture is darkened by a part of a stop.
    assert shown == factor if factor else 0.95 * 2**-0.6 < shown * luma < 1

    everywhere = np.ones((SIZE, SIZE, 3))
    diffuse = picture(out, "irradiance", suffix="exr")
    np.testing.assert_allclose(diffuse, light * everywhere, rtol=1e-3)
    seen_by_networks = agx(0.4 / luma * light)
    np.testing.assert_allclose(picture(out, "irradiance"), seen_by_networks * everywhere, atol=STEP)
    coat = directional_albedo(float(-view.forward[2]), roughness**2)
    assert coat > 0.05
    linear = picture(out, "relit", suffix="exr")
    np.testing.assert_allclose(linear, (1 + coat) * light * everywhere, rtol=3e-3)
    expected = agx(shown * (1 + coat) * light, look="photograph")
    np.testing.assert_allclose(picture(out, "relit"), expected * everywhere, atol=2 * STEP)


def test_alpha_is_the_mask(over):
    rgba, mask = picture(over / "transparent", "relit"), picture(over / "transparent", "mask", suffix="exr")
    assert rgba.shape == (SIZE, SIZE, 4)
    np.testing.assert_allclose(rgba[..., 3], mask[..., 0], atol=0.5 / 255 + 1e-4)
    assert {0.0, 1.0} <= set(rgba[..., 3].ravel().round(2))


def test_opaque_pixels_do_not_depend_on_the_background(over):
    shown = {name: picture(over / name, "relit")[..., :3] for name in BACKGROUNDS}
    mask = picture(over / "colour", "mask", suffix="exr")[..., 0]
    opaque, empty = mask > 0.991, mask == 0
    assert opaque.sum() > 300
    assert empty.sum() > 50
    for name in ("transparent", "colour"):
        np.testing.assert_array_equal(shown[name][opaque], shown["environment"][opaque])
    np.testing.assert_allclose(shown["colour"][empty], np.tile([0.2, 0.9, 0.4], (empty.sum(), 1)), atol=STEP)
    assert (shown["transparent"][empty] == 0).all()
    assert np.ptp(shown["environment"][empty]) > 0.1


def test_foreground_over_the_sky_is_the_picture_in_the_environment(over, lights):
    """The buffers let anyone composite by the one rule of tron.shading.composition."""
    folder = over / "environment"
    foreground, mask, lit, relit = (
        picture(folder, name, suffix="exr") for name in ("foreground", "mask", "lit", "relit")
    )
    camera = Camera.from_dict(json.loads((folder / "relight.json").read_text())["cameras"][0])
    share = background_share(1 - mask)
    sky = EnvironmentMap.load(lights[0]).lookup(camera.rays())
    assert ((share > 0.05) & (share < 0.95)).sum() > 10, "rims are tested"
    np.testing.assert_allclose((1 - share) * foreground + share * sky, lit, rtol=0.01, atol=2e-3)
    np.testing.assert_array_equal(relit, lit)
    exposure = json.loads((folder / "relight.json").read_text())["exposure"]
    expected = to_display(lit, exposure, look="photograph")
    np.testing.assert_allclose(picture(folder, "relit"), expected, atol=STEP)


def test_foreground_over_one_radiance_is_the_picture_of_sub_pixels_too(relight, scene_path, tmp_path):
    """The share is the mean of those of sub-pixels, which at rims is not the share of their mean opacity."""
    radiance = np.array([2.0, 4.0, 8.0])
    EnvironmentMap.constant(radiance).save(tmp_path / "c.exr")
    files = [f"scene={scene_path}", f"environment={tmp_path / 'c.exr'}", f"output_dir={tmp_path}", "frames=1"]
    assert relight(*files, "supersample=2", "checkpoint=null") == 0
    foreground, mask, share, lit = (
        picture(tmp_path, name, suffix="exr") for name in ("foreground", "mask", "share", "lit")
    )
    of_mean = background_share(1 - mask)
    assert (np.abs(share - of_mean) > 0.005).sum() > 10, "rims are tested"
    np.testing.assert_allclose((1 - share) * foreground + share * radiance, lit, rtol=2e-3, atol=2e-3)
    assert relight(*files, "supersample=2", "checkpoint=null", "background=[0.2,0.9,0.4]") == 0
    assert json.loads((tmp_path / "relight.json").read_text())["frames_rendered"] == 0
    exposure = json.loads((tmp_path / "relight.json").read_text())["exposure"]
    shown = to_display(foreground, exposure, look="photograph")
    expected = (1 - share) * shown + share * np.array([0.2, 0.9, 0.4])
    np.testing.assert_allclose(picture(tmp_path, "relit"), expected, atol=STEP)


def test_linear_picture_without_a_sky_is_multiplied_by_its_alpha(over):
    relit, foreground, mask = (
        picture(over / "transparent", name, suffix="exr") for name in ("relit", "foreground", "mask")
    )
    np.testing.assert_allclose(relit, np.concatenate([foreground * mask, mask], 2), rtol=2e-3, atol=1e-4)


def test_another_background_traces_nothing_again(relight, scene_path, lights, tmp_path):
    base = [f"scene={scene_path}", f"environment={lights[0]}", f"output_dir={tmp_path}", "frames=1"]
    for background, traced in (("environment", 1), ("transparent", 0), ("[1,1,1]", 0)):
        assert relight(*base, f"background={background}") == 0
        assert json.loads((tmp_path / "relight.json").read_text())["frames_rendered"] == traced
    assert picture(tmp_path, "relit").shape[2] == 3


def test_what_has_alpha_is_black_behind_in_videos_and_sheets(
    relight, scene_path, lights, tmp_path, read_video
):
    base = [f"scene={scene_path}", f"environment={lights[0]}", f"output_dir={tmp_path}", "frames=2"]
    assert relight(*base, "background=transparent") == 0
    empty = picture(tmp_path, "relit")[..., 3] == 0
    assert empty[0, 0]
    assert read_video(tmp_path / "relit.mp4")[0][:3, :3].max() < 12
    sheet = read_image(tmp_path / "contact_sheet.png")[18 : 18 + SIZE, 110 : 110 + SIZE]
    assert (sheet[empty] == 0).all()


def test_a_networks_picture_is_composited_by_the_mask(relight, scene_path, lights, tmp_path):
    from tron.neural.configs import PixelMLPConfig
    from tron.neural.networks.pixel_mlp import PixelMLP
    from tron.neural.weights import save_renderer

    save_renderer(tmp_path / "r.safetensors", PixelMLP(PixelMLPConfig(width=4)))
    base = [f"scene={scene_path}", f"environment={lights[0]}", f"output_dir={tmp_path / 'out'}", "frames=1"]
    base += [f"checkpoint={tmp_path / 'r.safetensors'}", "buffers=[mask]"]
    assert relight(*base, "background=transparent") == 0
    neural, mask = picture(tmp_path / "out", "neural"), picture(tmp_path / "out", "mask", suffix="exr")
    rgba = picture(tmp_path / "out", "relit")
    report = json.loads((tmp_path / "out" / "relight.json").read_text())
    linear = from_agx(neural) / report["guidance_exposure"]
    shown = to_display(linear, report["exposure"], look="photograph")
    bright = (neural > 0.1) & (neural < 0.9)  # elsewhere eight bits of the file say little
    np.testing.assert_allclose(rgba[..., :3][bright], shown[bright], atol=0.03)
    np.testing.assert_allclose(rgba[..., 3:], mask, atol=0.5 / 255 + 1e-4)
    assert relight(*base, "background=[1,0,0]") == 0
    share = background_share(1 - mask)
    expected = (1 - share) * rgba[..., :3] + share * np.array([1.0, 0, 0])
    np.testing.assert_allclose(picture(tmp_path / "out", "relit"), expected, atol=STEP)


def test_a_turn_starts_at_its_first_angle_and_loops():
    def turned(rotation, frames: int) -> list[float]:
        files = {"scene": "a.ply", "environment": "a.hdr", "output_dir": "out"}
        return Settings.model_validate({**files, "rotation": rotation}).rotations(frames)

    assert turned(30, 3) == [30, 30, 30]
    assert turned([0, 360], 4) == [0, 90, 180, 270]
    assert turned([90, -90], 2) == [90, 0]


@pytest.fixture
def counted(monkeypatch) -> dict[str, int]:
    """Calls so far of what bounces cost: "trace" a scene's transport, "bake" a light."""
    from tron.shading.bounces.bounce import BounceTransport

    calls = {"trace": 0, "bake": 0}

    def count(name: str, call: Callable) -> Callable:
        def counting(*args, **named):
            calls[name] += 1
            return call(*args, **named)

        return counting

    monkeypatch.setattr(BounceTransport, "trace", count("trace", BounceTransport.trace))
    monkeypatch.setattr(BounceTransport, "bake", count("bake", BounceTransport.bake))
    return calls


def test_a_turning_light_on_a_still_view_is_each_angle_alone(relight, scene_path, lights, tmp_path, counted):
    """The same bytes; what bounces is traced once, and baked for each angle."""
    base = [f"scene={scene_path}", f"environment={lights[0]}", "trajectory=still", "frames=3", "exposure=1"]
    assert relight(*base, f"output_dir={tmp_path / 'turning'}", "rotation=[0,360]") == 0
    assert counted == {"trace": 1, "bake": 3}
    assert json.loads((tmp_path / "turning" / "relight.json").read_text())["rotations"] == [0, 120, 240]
    assert relight(*base, f"output_dir={tmp_path / 'at'}", "rotation=120", "reproject=1") == 0
    turning, alone = (frame_files(tmp_path / name, index=1) for name in ("turning", "at"))
    assert turning == alone
    report = json.loads((tmp_path / "turning" / "relight.json").read_text())
    rays = Camera.from_dict(report["cameras"][1]).rays()
    empty = picture(tmp_path / "turning", "mask", 1, "exr")[..., 0] == 0
    sky = EnvironmentMap.load(lights[0], rotation_deg=120).lookup(rays)[empty]
    shown = picture(tmp_path / "turning", "lit", 1, "exr")[empty]
    np.testing.assert_allclose(shown, sky, rtol=0.01, atol=2e-3)
    unshadowed = [picture(tmp_path / "turning", "unshadowed", index, "exr") for index in range(2)]
    assert np.abs(unshadowed[0] - unshadowed[1])[~empty].mean() > 0.01, "surfaces see it turn"
    masks = [picture(tmp_path / "turning", "mask", index, "exr") for index in range(3)]
    assert (masks[0] == masks[2]).all()


def test_without_bounces_the_picture_is_shadowed_and_nothing_is_traced_for_them(
    relight, scene_path, lights, tmp_path, counted, read_video
):
    base = [f"scene={scene_path}", f"environment={lights[0]}", "frames=1", f"output_dir={tmp_path}"]
    assert relight(*base, "bounces=0", "buffers=[relit,lit,indirect,mask]") == 0
    assert counted == {"trace": 0, "bake": 0}
    assert json.loads((tmp_path / "relight.json").read_text())["relit"] == "shadowed"
    relit, lit, shadowed, indirect, mask = (
        picture(tmp_path, name, suffix="exr") for name in ("relit", "lit", "shadowed", "indirect", "mask")
    )
    np.testing.assert_array_equal(relit, shadowed)
    np.testing.assert_array_equal(lit, shadowed)
    assert (indirect[mask[..., 0] > 0.999] == 0).all()
    assert read_video(tmp_path / "guidance.mp4").shape[1:3] == (SIZE, 2 * SIZE), "pbr and irradiance"
    sheet = read_image(tmp_path / "contact_sheet.png")
    assert sheet.shape[0] == 18 + 3 * (SIZE + 2), "the relit picture and those"


def test_bounced_light_fills_the_shadow_and_has_the_colour_of_what_sent_it(orbit_of_four):
    """A lamp on a reddish ball (base color 0.8, 0.3, 0.2) over a grey floor, which turns red beside it."""
    names = ("indirect", "lit", "shadowed", "normal", "position")
    indirect, lit, shadowed, normal, position = (picture(orbit_of_four, name, 0, "exr") for name in names)
    on_floor = (normal[..., 2] > 0.99) & (position[..., 2] < 0.05)
    from_ball = np.linalg.norm(position[..., :2], axis=-1)
    near, far = on_floor & (from_ball < 0.5), on_floor & (from_ball > 1.2)
    assert near.sum() > 10
    assert far.sum() > 10
    assert indirect[near].mean() > 2 * indirect[far].mean()
    red = [indirect[where][:, 0].mean() / indirect[where][:, 2].mean() for where in (near, far)]
    assert red[0] > 1.3
    assert lit[near].mean() > 1.02 * shadowed[near].mean()


def frame_files(output_dir: Path, index: int | None = None) -> dict[str, bytes]:
    pattern = "[0-9]*.*" if index is None else f"{index:04d}.*"
    return {path.name: path.read_bytes() for path in (output_dir / "frames").glob(pattern)}


def test_several_lights_give_what_each_gives_alone_from_one_scene(
    relight, scene_path, lights, tmp_path, monkeypatch, counted
):
    loaded = []
    load = GaussianScene.load
    monkeypatch.setattr(GaussianScene, "load", lambda path: loaded.append(path) or load(path))
    base = [f"scene={scene_path}", "frames=2"]
    both = f"environment=[{lights[0]},{lights[1]}]"
    assert relight(*base, both, f"output_dir={tmp_path / 'both'}") == 0
    assert (len(loaded), counted) == (1, {"trace": 1, "bake": 2})
    for light in lights:
        assert relight(*base, f"environment={light}", f"output_dir={tmp_path / light.stem}") == 0
        together, alone = tmp_path / "both" / light.stem, tmp_path / light.stem
        assert frame_files(together) == frame_files(alone)
        assert (together / "relit.mp4").read_bytes() == (alone / "relit.mp4").read_bytes()
        reports = [json.loads((folder / "relight.json").read_text()) for folder in (together, alone)]
        assert reports[0]["exposure"] == reports[1]["exposure"]
        assert reports[0]["settings"]["environment"] == str(light)
    lost = tmp_path / "both" / "night" / "frames" / "0001.mask.exr"
    before = lost.read_bytes()
    lost.unlink()
    assert relight(*base, both, f"output_dir={tmp_path / 'both'}") == 0
    rendered = [
        json.loads((tmp_path / "both" / light.stem / "relight.json").read_text())["frames_rendered"]
        for light in lights
    ]
    assert rendered == [0, 1]
    assert counted == {"trace": 4, "bake": 5}, "only the light of a lost frame is baked again"
    assert lost.read_bytes() == before


def test_every_file_is_looked_for_before_the_scene_is_loaded(
    relight, scene_path, lights, tmp_path, monkeypatch, capsys
):
    def unwanted(path):
        raise AssertionError(f"{path} was loaded")

    monkeypatch.setattr(GaussianScene, "load", unwanted)
    base = [f"scene={scene_path}", f"output_dir={tmp_path / 'out'}"]
    (tmp_path / "broken.hdr").write_text("<html>")
    (tmp_path / "broken.json").write_text("[]")
    for wrong in (
        f"environment=[{lights[0]},{tmp_path / 'absent.hdr'}]",
        f"environment={tmp_path / 'broken.hdr'}",
        f"cameras={tmp_path / 'broken.json'}",
        f"checkpoint={tmp_path / 'absent.safetensors'}",
        f"vae={tmp_path / 'absent.pth'}",
    ):
        assert relight(*base, f"environment={lights[0]}", wrong) == 2
        assert Path(wrong.rstrip("]")).name in capsys.readouterr().err


def test_a_thing_without_a_floor_stands_on_a_ground_that_it_shadows(relight, dense_surfels, tmp_path):
    """Below the ball it is darker than the map, and brighter where the plane lies deeper."""
    ball = dense_surfels.scene(dense_surfels.sphere(0.08, 0.5), spacing=0.08)
    ball.save(tmp_path / "ball.ply")
    replace(ball, offset=np.array([0.0, 0.0, 1000.0])).save(tmp_path / "map.ply")
    EnvironmentMap.constant(1.0).save(tmp_path / "c.exr")
    base = [f"environment={tmp_path / 'c.exr'}", "trajectory=still", "frames=1", "buffers=[relit,mask]"]
    shown = {}
    for ground in ("auto", "none", "-3.0", "997.0"):
        out, scene = tmp_path / ground, "map" if ground == "997.0" else "ball"
        files = [f"scene={tmp_path / scene}.ply", f"output_dir={out}"]
        assert relight(*base, *files, f"ground={ground}", "distance=1.6") == 0
        empty = picture(out, "mask", suffix="exr")[..., 0] == 0
        shown[ground] = picture(out, "relit", suffix="exr")[empty]
    np.testing.assert_allclose(shown["none"], 1, atol=1e-3)
    assert shown["auto"].min() < 0.7
    assert shown["auto"].max() == pytest.approx(1, abs=1e-3)
    assert shown["auto"].min() + 0.1 < shown["-3.0"].min()
    np.testing.assert_allclose(shown["997.0"], shown["-3.0"], atol=2e-3)  # on the map, 1,000 higher

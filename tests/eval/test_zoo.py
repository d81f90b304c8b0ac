"""The benchmark `zoo`: what is drawn, how cells are judged, its wall; a tiny one by the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.results import Results
from eval.tracing.furnace import place
from eval.zoo import cells as zoo_cells
from eval.zoo import sheets
from eval.zoo.cells import QUALITIES, Cell, covered, measured
from eval.zoo.lights import JUDGED, SUN_SHARE, Light, disc, draw_lights, photographed
from eval.zoo.materials import BRIGHTNESS, STRATA, WIDE_STRATA, Material, draw_materials
from eval.zoo.rows import group, zoo_rows
from eval.zoo.shapes import FILLED, KINDS, SIDE, SPACING, Shape, draw_shape, individuals
from eval.zoo.sheets import Sheet, inner, sheet_rows, two_layers
from eval.zoo.wall import (
    BAR,
    BRIGHT,
    DIM,
    EDGE,
    GAP,
    MEANS,
    NEUTRAL,
    THUMB,
    WIDE,
    draw_wall,
    error_color,
    mean_color,
    off,
    tile,
    worst,
)
from eval.zoo.witness import SHARE, chosen, write_cells
from tron.models.load import load_model
from tron.models.parts import outline
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

GREY = Material("grey", (0.5, 0.5, 0.5), 0.6, 0.0)


def cell(
    preview: float = 1.0,
    final: float = 1.0,
    *,
    shape: str = "box",
    number: int = 0,
    material: Material = GREY,
    light: str = "even",
) -> Cell:
    """A cell whose truth is 2 and whose frames are so many times that; its rim, far off, does not count."""
    share = np.zeros((8, 8))
    share[1:7, 1:7], share[2:6, 2:6] = 0.5, 1
    truth, rim = np.full((8, 8, 3), 2.0), share[..., None] < 1
    lit = {name: np.where(rim, 50.0, each * truth) for name, each in zip(QUALITIES, (preview, final))}
    return Cell(shape, number, material, light, 0.2, share, truth, lit, {"preview": 30.0})


def values(rows) -> dict[str, float]:
    return {row.metric: row.value for row in rows}


@pytest.mark.parametrize("seed", range(5))
def test_every_kind_of_material_is_drawn_whatever_the_seed(seed: int):
    drawn = draw_materials(generator(seed, "test"), STRATA, 2)
    assert len(drawn) == 4 * len(STRATA)
    for metallic in (0.0, 1.0):
        of = [each for each in drawn if each.metallic == metallic]
        assert {each.color for each in of} == set(BRIGHTNESS)
        for low, high in STRATA:
            assert sum(low <= each.roughness <= high for each in of) >= 2
    for each in drawn:
        low, high = BRIGHTNESS[each.color]
        assert low <= max(each.base_color) <= high
        assert (min(each.base_color) < 0.25 * max(each.base_color)) == (each.color == "saturated")
    assert drawn == draw_materials(generator(seed, "test"), STRATA, 2)
    assert drawn != draw_materials(generator(seed + 1, "test"), STRATA, 2)


def test_the_zoo_has_every_shape_with_metals_and_dielectrics_of_every_color():
    drawn = list(individuals(list(KINDS), None, 3))
    for kind in KINDS:
        of_kind = [material for shape, materials in drawn for material in materials if shape.kind == kind]
        assert {each.color for each in of_kind} == set(BRIGHTNESS)
        strata = STRATA if kind == "ball" else WIDE_STRATA
        assert (
            len(
                {(m.metallic, k) for m in of_kind for k, (a, b) in enumerate(strata) if a <= m.roughness <= b}
            )
            >= 6
        )
    few = list(individuals(["ball", "box"], 2, 3))
    assert [len(materials) for _, materials in few] == [2, 2, 2]
    assert {each.metallic for each in few[0][1]} == {0.0, 1.0}


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_drawn_anew_by_their_seed(kind: str):
    one, again, other = (draw_shape(kind, 0, seed) for seed in (3, 3, 4))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(one.parts, again.parts, strict=True))
    np.testing.assert_array_equal(one.camera.world_to_camera, again.camera.world_to_camera)
    assert not np.array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
    corners = np.concatenate([part.vertices for part in one.parts])
    assert np.linalg.norm(corners, axis=1).max() == pytest.approx(1)
    for part in one.parts:
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        assert (np.einsum("nk,nk->n", np.cross(b - a, c - a), part.normals[part.faces].sum(1)) > 0).all()


@pytest.mark.parametrize("kind", ["ball", "bowl", "box", "steps"])
def test_closed_shapes_face_outwards(kind: str):
    """Area times normals of a closed surface add up to nothing, and its volume is not negative."""
    mesh = outline(draw_shape(kind, 1, 5).parts)
    total = (mesh.area_faces[:, None] * mesh.face_normals).sum(0)
    np.testing.assert_allclose(total, 0, atol=1e-6 * mesh.area)
    assert 0.1 < mesh.volume < 4 / 3 * np.pi


@pytest.mark.usefixtures("variant")
def test_surfels_stand_on_the_shape_and_singles_have_two_sides():
    for kind in ("box", "leaf"):
        shape = draw_shape(kind, 0, 5)
        steady = replace(shape, jitter=0.0)
        scene = steady.surfels(GREY)
        if kind == "box":
            half = np.abs(np.concatenate([part.vertices for part in shape.parts])).max(0)
            assert np.abs(half - np.abs(scene.means)).min(1).max() < 0.01 * SPACING
        up = (scene.normals() @ scene.normals()[0] > 0).mean()
        assert (0.4 < up < 0.6) == (kind == "leaf")
    shaken = shape.surfels(GREY)
    off_plane = np.einsum("nk,nk->n", shaken.means - scene.means, scene.normals())
    assert off_plane.std() == pytest.approx(shape.jitter * SPACING, rel=0.1)
    other = shape.surfels(GREY._replace(base_color=(0.1, 0.9, 0.2), roughness=0.3, metallic=1.0))
    np.testing.assert_array_equal(other.means, shaken.means)
    np.testing.assert_allclose(other.base_color, np.tile([0.1, 0.9, 0.2], (len(other), 1)), rtol=1e-5)


@pytest.mark.usefixtures("variant")
def test_fogs_are_thick_and_of_no_sign():
    scene = draw_shape("thick", 0, 5).surfels(GREY)
    radii = np.linalg.norm(scene.means, axis=1)
    assert not scene.oriented
    assert 0.7 < radii.std() / SPACING < 1.0
    assert (np.einsum("nk,nk->n", scene.means, scene.normals()) > 0).mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.usefixtures("variant")
def test_lights_are_the_photographed_ones_or_drawn(tmp_path: Path):
    for k, stem in enumerate((*JUDGED.values(), "cave-1_1k")):
        EnvironmentMap.constant(k + 1.0).save(tmp_path / f"{stem}.hdr")
    found, again, drawn = draw_lights(tmp_path, 3), draw_lights(tmp_path, 3), draw_lights(None, 3)
    assert [each.name for each in found] == [*JUDGED, "cave_1", "sun", "even"]
    assert photographed(found)
    assert not photographed(drawn)
    assert len(drawn) == len(found) == len({each.name for each in drawn})
    assert [each.environment.rotation_deg for each in found] == [
        each.environment.rotation_deg for each in again
    ]
    (sun,) = (each.environment for each in found if each.name == "sun")
    up = sun.unoccluded_upward().mean()
    dim = EnvironmentMap(np.minimum(sun.image, 1)).unoccluded_upward().mean()
    assert up / dim > 0.8 * SUN_SHARE


def test_discs_have_their_solid_angle():
    light = EnvironmentMap(disc(50, 30, 20)[..., None] * np.ones(3))
    assert light.mean()[0] == pytest.approx((1 - np.cos(np.radians(20))) / 2, rel=0.02)
    brightest = light.directions()[np.unravel_index(light.image[..., 0].argmax(), light.image.shape[:2])]
    assert np.degrees(np.arcsin(brightest[2])) == pytest.approx(50, abs=21)


def test_cells_are_judged_where_the_shape_fills_pixels():
    found = cell(1.1, 0.7)
    assert found.mean("preview") == pytest.approx(1.1)
    assert found.error("preview") == pytest.approx(0.1)
    assert found.error("final") == pytest.approx(0.3)
    found.lit["final"][3, 3:5] = 4.6  # a mean may hide what an error shows
    assert found.mean("final") == pytest.approx((14 * 0.7 + 2 * 2.3) / 16)
    assert found.error("final") == pytest.approx((14 * 0.3 + 2 * 1.3) / 16)


@pytest.mark.usefixtures("variant")
def test_a_balls_disk_is_covered():
    share = covered(draw_shape("ball", 0, 3))
    assert share.mean() == pytest.approx(np.pi / 4 * FILLED**2, rel=0.01)
    rim = (share > 0) & (share < 1)
    assert 0.8 * np.pi * FILLED * SIDE < rim.sum() < 2 * np.pi * FILLED * SIDE


def test_the_worst_are_the_worst_of_all_and_shapes_are_means():
    found = values(zoo_rows([cell(1.0, 1.02), cell(0.88, 1.0), cell(1.2, 1.05, shape="leaf")]))
    assert found["zoo.worst_mean"] == pytest.approx(0.2)
    assert found["zoo.worst_error"] == pytest.approx(0.2)
    assert found["zoo.share_within"] == pytest.approx(1 / 3)
    assert found["zoo.mean.box.preview"] == pytest.approx(0.94)
    assert found["zoo.farthest.box.preview"] == pytest.approx(0.88)
    assert found["zoo.worst_shape"] == pytest.approx(0.2)
    assert found["zoo.psnr.preview"] == 30
    assert not [name for name in found if ".ball" in name]


def test_ways_are_compared_on_the_cells_that_all_have():
    both, one = cell(), cell()
    both.psnr, one.psnr = {"preview": 20.0, "preview_oidn": 25.0}, {"preview": 40.0}
    found = values(zoo_rows([both, one]))
    assert (found["zoo.psnr.preview"], found["zoo.psnr.preview_oidn"]) == (20, 25)


def test_balls_are_held_by_roughness_and_light():
    rough, shiny = GREY._replace(roughness=1.0), GREY._replace(roughness=0.1, metallic=1.0)
    found = values(
        zoo_rows(
            [
                cell(1.03, 0.96, shape="ball", material=rough, light="venice"),
                cell(0.8, 1.01, shape="ball", material=shiny, light="venice"),
                cell(0.5, 1.5, shape="box", material=rough, light="venice"),
            ]
        )
    )
    assert found["zoo.ball.mean"] == pytest.approx(0.04)
    assert found["zoo.ball.shiny_mean"] == pytest.approx(0.2)
    assert found["zoo.ball.rough_error.venice"] == pytest.approx(0.04)
    assert found["zoo.ball.polished_error.venice"] == pytest.approx(0.01)
    assert found["zoo.ball_mean.metal_polished_preview.venice"] == pytest.approx(0.8)
    assert group(cell(material=GREY._replace(roughness=0.25))) == "dielectric_middle"


def test_sheets_are_as_they_are_told():
    scene = two_layers(0.5, 0.25, 0.2, (sheets.WHITE, sheets.BLACK), generator(0, "test"))
    half = len(scene) // 2
    up = scene.normals()[:, 2]
    assert (up[:half] > 0).all()
    assert (up[half:] < 0).all()
    for heights, at in ((scene.means[:half, 2], 0.0), (scene.means[half:, 2], -0.5)):
        assert heights.mean() / sheets.SPACING == pytest.approx(at, abs=0.02)
        assert heights.std() / sheets.SPACING == pytest.approx(0.25, rel=0.05)
    np.testing.assert_allclose(scene.base_color[half:], 0.05)


def test_the_worst_sheet_counts_and_less_is_asked_where_layers_touch():
    found = values(
        sheet_rows([Sheet(0, 0.25, "final", 0.9, 0.3, 0.0), Sheet(0.5, 0.1, "final", 0.97, 0.1, 0.02)])
    )
    assert found["zoo.sheet.touching_mean"] == pytest.approx(0.1)
    assert found["zoo.sheet.mean"] == pytest.approx(0.03)
    assert found["zoo.sheet.dark"] == 0.3
    assert found["zoo.sheet.leak"] == 0.02
    assert found["zoo.sheet.final_leak.50_10"] == 0.02


def test_the_inner_pixels_are_of_the_sheet():
    from tron.cameras import Camera

    camera = Camera.look_at((0, 0, 2), (0, 0, 0), up=(0, 1, 0), fov_deg=53.13, width=100, height=100)
    assert inner(camera).sum() == pytest.approx(30**2, rel=0.05)  # two units across, 0.6 of them inside


def test_colors_say_which_way_and_how_far():
    np.testing.assert_allclose(mean_color(1.0), NEUTRAL)
    np.testing.assert_allclose(mean_color(1 + MEANS), BRIGHT)
    np.testing.assert_allclose(mean_color(1 / (1 + MEANS)), DIM)
    np.testing.assert_allclose(mean_color(0.0), DIM)
    np.testing.assert_allclose(error_color(0.0), NEUTRAL)


def test_a_tile_has_preview_left_final_right_and_the_frame_in_the_middle():
    shown = tile(cell(1.25, 1.0))
    np.testing.assert_allclose(shown[0, 0], BRIGHT)
    np.testing.assert_allclose(shown[0, WIDE - GAP - 1], NEUTRAL)
    bar = shown[2 * EDGE + THUMB + BAR // 2]
    np.testing.assert_allclose(bar[0], error_color(0.25))
    np.testing.assert_allclose(bar[WIDE - GAP - 1], NEUTRAL)
    middle = shown[EDGE + THUMB // 2, EDGE + THUMB // 2]
    assert np.abs(middle - NEUTRAL).max() > 0.1


def test_the_worst_of_the_wall_are_of_different_materials():
    other = GREY._replace(roughness=0.9)
    many = [cell(0.5), cell(1.0, 3.0, light="sun"), cell(1.2, material=other), cell(1.01, shape="leaf")]
    found = worst(many, off, 3)
    assert [(each.light, quality) for each, quality in found[:1]] == [("sun", "final")]
    assert [each.material for each, _ in found] == [GREY, other, GREY]
    assert found[2][0].shape == "leaf"


def test_the_wall_shows_every_cell():
    many = [
        cell(1.25, light=light, material=GREY._replace(roughness=r)) for light in "ab" for r in (0.3, 0.7)
    ]
    wall = draw_wall([*many, cell(0.8, shape="leaf", light="a")])
    assert wall.ndim == 3
    assert wall.shape[2] == 3
    levels = np.round(wall * 255).astype(int)
    half = (WIDE - GAP) // 2 * 2 * EDGE  # at least the edges of a tile's left half
    for color, count in ((BRIGHT, 4), (DIM, 1)):
        assert (np.abs(levels - np.round(color * 255)) <= 1).all(-1).sum() > count * half


def test_cells_of_another_renderer_are_a_tenth_and_stand_apart(tmp_path: Path):
    shapes = {(kind, 0): draw_shape(kind, 0, 5) for kind in ("box", "leaf", "relief", "thick")}
    many = [
        cell(shape=kind, material=GREY._replace(roughness=0.3 + 0.01 * n))
        for kind, _ in shapes
        for n in range(2 * SHARE)
    ]
    some = chosen(many, shapes, 0)
    assert [each.shape for each in some] == ["box", "box", "leaf", "leaf"]
    assert some == chosen(many, shapes, 0)
    write_cells(tmp_path / "cells.glb", some, shapes)
    parts = load_model(tmp_path / "cells.glb", fitted=False)
    assert len(parts) == len(some)  # those of one material are one
    for number, each in enumerate(some):
        own = [part for part in parts if np.linalg.norm(part.vertices.mean(0) - place(number)) < 2]
        assert [part.roughness for part in own] == pytest.approx([each.material.roughness])
        np.testing.assert_allclose(own[0].base_color, 0.5, rtol=1e-6)
        middle = outline(shapes[each.shape, 0].parts).bounds.mean(0) + place(number)
        np.testing.assert_allclose(outline(own).bounds.mean(0), middle, atol=1e-5)


@pytest.fixture(scope="module")
def even(variant: str) -> Light:
    return Light("even", EnvironmentMap.constant(1.0))


def test_a_ball_under_even_light_is_right_and_holes_are_not_its_lights(
    even: Light, monkeypatch: pytest.MonkeyPatch
):
    """Surfels let 2 % of a pixel through, which is divided out; a white one half as bright is found."""
    monkeypatch.setattr(zoo_cells, "EVEN_PATHS", 16)
    shape: Shape = draw_shape("ball", 0, 3)
    white, grey = GREY._replace(base_color=(1.0, 1.0, 1.0)), GREY
    found = list(measured(shape, [white, grey], [even], 3, [], {}))
    for each in found:
        for quality in QUALITIES:
            assert each.mean(quality) == pytest.approx(1, abs=0.02)
            assert each.error(quality) < 0.06
            assert each.psnr[quality] > 30
    crossed = replace(found[0], lit=found[1].lit)
    assert crossed.mean("final") == pytest.approx(0.5, abs=0.05)


@pytest.mark.usefixtures("variant")
def test_an_edge_mirrors_no_lamp_that_neither_of_its_faces_does(monkeypatch: pytest.MonkeyPatch):
    """The lamp stands where a mean of both faces' normals mirrors it; path tracing does not see it."""
    monkeypatch.setattr(zoo_cells, "PATHS", 64)
    shape = draw_shape("box", 0, 3)
    eye = np.asarray(shape.camera.position) / np.linalg.norm(shape.camera.position)
    faces = sorted({tuple(np.round(part.normals[0])) for part in shape.parts}, key=lambda n: -(eye @ n))
    mixed = np.add(*faces[:2]) / np.sqrt(2)
    x, y, z = 2 * (mixed @ eye) * mixed - eye
    lamp = disc(np.degrees(np.arcsin(z)), np.degrees(np.arctan2(y, x)), 8.0)[..., None] * np.full(3, 100.0)
    light = Light("lamp", EnvironmentMap(lamp + 0.3))
    (found,) = measured(shape, [Material("grey", (0.5, 0.5, 0.5), 0.1, 1.0)], [light], 3, [], {})
    for quality in QUALITIES:
        assert found.mean(quality) == pytest.approx(1, abs=0.03)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=zoo", *arguments])
    return int(end.value.code or 0)


@pytest.mark.long
def test_a_tiny_zoo_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for module, toy in ((zoo_cells, {"PATHS": 16, "EVEN_PATHS": 4}), (sheets, {"GAPS": (0.5,), "PATHS": 4})):
        for name, value in toy.items():
            monkeypatch.setattr(module, name, value)
    small = ("benchmark.shapes=[ball,sheet,thick]", "benchmark.lights=[drawn1,even]", "benchmark.materials=2")
    assert run("benchmark.seed=5", *small, "benchmark.real_data=null", f"output_dir={tmp_path}") == 0
    results = Results.load(tmp_path / "results.json")
    for metric in ("worst_mean", "worst_error", "share_within", "ball.mean", "sheet.dark", "sheet.leak"):
        assert results.value(f"zoo.{metric}") is not None
    assert results.value("zoo.psnr.preview_network") is not None
    assert "zoo.ball.rough_error.venice" in results.absent
    assert 0.9 < (results.value("zoo.mean.sheet.final") or 0) < 1.1
    page = (tmp_path / "report.html").read_text()
    assert '<section id="wall">' in page or "every cell of the zoo" in page
    assert (tmp_path / "pictures" / "wall.png").is_file()


def test_a_light_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    wrong = ("benchmark.lights=[moon]", "benchmark.real_data=null", "benchmark.parts=[cells]")
    assert run(*wrong, f"output_dir={tmp_path / 'out'}") == 2
    assert "no light moon" in capsys.readouterr().err

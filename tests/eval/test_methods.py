"""TRON's own methods write folders like anyone's: a world in closed form, lit anew, judged by compare."""

# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalOperand=false, reportReturnType=false, reportOperatorIssue=false
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli, main
from eval.protocol.method import MethodFolder
from eval.protocol.suite import NewScene, Suite, write_suite
from eval.results import Results
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.color import to_display
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap

ALBEDO = np.array([0.6, 0.4, 0.25], np.float32)
SIZE = 32


def floor_seen(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) distances to a square of side 4 in z = 0, 0 beside it, and base color: a darker half, x < 0."""
    rays = camera.rays()
    with np.errstate(divide="ignore"):
        distance = -camera.position[2] / rays[..., 2]
    points = camera.position + rays * distance[..., None]
    hit = (distance > 0) & (np.abs(points[..., :2]) < 2).all(-1)
    color = np.where(points[..., :1] < 0, 0.5 * ALBEDO, ALBEDO)
    return np.where(hit, distance, 0), np.where(hit[..., None], color, 0).astype(np.float32)


def around(radius: float, count: int, turn: float) -> list[Camera]:
    angles = turn + np.arange(count) * 2 * np.pi / count
    places = [(radius * np.cos(a), radius * np.sin(a), 3.0) for a in angles]
    return [Camera.look_at(p, (0, 0, 0), fov_deg=50, width=SIZE, height=SIZE) for p in places]


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """A floor in the open under even light: a rough surface sends back base color times light, nearly."""
    train, test = around(3.0, 8, 0.0), around(2.5, 2, 0.3)

    def views(cameras: Sequence[Camera]) -> tuple[View, ...]:
        found = []
        for k, camera in enumerate(cameras):
            depth, color = floor_seen(camera)
            mask = (depth > 0).astype(np.float32)
            normal = mask[..., None] * np.array([0, 0, 1], np.float32)
            maps = {"base_color": color, "normal": normal, "depth": depth, "mask": mask}
            maps |= {"roughness": mask, "metallic": 0 * mask}
            found.append(View(f"v{k}", camera, to_display(color, 0.4), "display", **maps))
        return tuple(found)

    seen = [floor_seen(camera) for camera in test]
    color, mask = np.stack([c for _, c in seen]), np.stack([(d > 0).astype(np.float32) for d, _ in seen])
    lights = {
        f"{k}_even": (EnvironmentMap.constant(value), 0.4 / value, "even", color * np.float32(value))
        for k, value in enumerate((1.0, 3.0), 1)
    }
    normals = mask[..., None] * np.array([0, 0, 1], np.float32)
    maps = {"mask": mask, "albedo": color, "normals": normals}
    capture = Capture(views(train))
    scene = NewScene("floor", "object", lambda path: write_capture(path, capture), None, test, lights, maps)
    return write_suite(tmp_path_factory.mktemp("suites") / "floors", "floors", [scene])


def test_surfels_from_true_maps_relight_a_floor(suite: Suite, tmp_path: Path):
    ways = "[pbr,pbr_x_irradiance,shadow_ratio,shadowed,lit,network]"
    made = ["method=true_maps", f"suite={suite.folder}", f"method.ways={ways}", "method.count=1500"]
    main(cli.compose(*made, f"output_dir={tmp_path / 'methods'}"))
    compared = [
        "benchmark=compare",
        f"suite={suite.folder}",
        f"methods={tmp_path / 'methods'}",
    ]
    main(cli.compose(*compared, f"output_dir={tmp_path / 'out'}"))
    results = Results.load(tmp_path / "out/results.json")
    figures = {row.metric: row.value for row in results.rows}
    # Even light over an open floor: nothing is shadowed, so all of them show base color times light, but for
    # the few percent that a dielectric mirrors.
    for way in ("pbr", "shadow_ratio", "shadowed", "lit", "network"):
        assert figures[f"maps_{way}.psnr"] > 29, way
        assert figures[f"maps_{way}.faults"] == 0
    # The product has light twice, and no number that would mend it where the scale is absolute.
    assert figures["maps_pbr_x_irradiance.psnr"] < 25
    assert figures["maps_lit.albedo_psnr_unscaled"] > 35
    assert figures["maps_lit.normal_mae_deg"] < 0.5
    network = MethodFolder.load(tmp_path / "methods/maps_network", suite).method
    assert (network.color_space, network.saw) == ("display", ["true_maps", "other_scenes"])
    # What is finished is kept: not a byte is written anew.
    files = list((tmp_path / "methods").rglob("*.exr"))
    before = {path: path.stat().st_mtime_ns for path in files}
    main(cli.compose(*made, f"output_dir={tmp_path / 'methods'}"))
    assert {path: path.stat().st_mtime_ns for path in files} == before


def test_a_suite_without_true_maps_says_so(drawn_suite: Path, tmp_path: Path):
    arguments = ["method=true_maps", f"suite={drawn_suite}", f"output_dir={tmp_path / 'methods'}"]
    with pytest.raises(TronError, match=r"has no true depth .*: make surfels from photos"):
        main(cli.compose(*arguments))
    assert not list((tmp_path / "methods").glob("maps_*"))
    with pytest.raises(TronError, match=r"no suite: give suite=DIR"):
        main(cli.compose("method=photos", f"output_dir={tmp_path / 'methods'}"))


@pytest.mark.long
def test_surfels_from_photos_go_the_same_way(suite: Suite, tmp_path: Path):
    """A reconstruction of a few steps: its pictures say that they saw photos, and have their one factor."""
    few = ["prior=joint", "initial.count=400", "radiance.steps=60", "radiance.density.most=400"]
    few += ["prior.rounds=1", "prior.light.steps=10", "prior.light.points=100", "report.frames=0"]
    quoted = ",".join(f'"{each}"' for each in few)
    made = ["method=photos", f"suite={suite.folder}", "method.ways=[lit,network]"]
    made.append(f"method.reconstruct=[{quoted}]")
    main(cli.compose(*made, f"output_dir={tmp_path / 'methods'}"))
    compared = ["benchmark=compare", f"suite={suite.folder}", f"methods={tmp_path / 'methods'}"]
    main(cli.compose(*compared, f"output_dir={tmp_path / 'out'}"))
    results = Results.load(tmp_path / "out/results.json")
    for way in ("lit", "network"):
        method = MethodFolder.load(tmp_path / f"methods/photos_{way}", suite).method
        assert (method.color_space, method.scale, method.saw[:2]) == ("linear", "scene", ["photos", "masks"])
        assert (results.value(f"photos_{way}.psnr") or 0) > 15
        assert results.find(f"photos_{way}.seconds_fit") is not None
    assert results.value("compare.identical_rows") == 1

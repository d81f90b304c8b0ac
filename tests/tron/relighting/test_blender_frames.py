"""`lit` of surfels that are made from Blender's G-buffers, against Cycles' own pictures, by object."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tron.cameras import Camera, opengl_to_opencv
from tron.estimation import FINEST, PREVIEW
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.relighting import EnvironmentMap, Relighter

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("variant")]
OBJECTS = {1: "floor", 2: "ball", 3: "head", 4: "box", 5: "card"}


def layers(path: Path) -> dict[str, np.ndarray]:
    """Channels of Blender's first part, without the name of its view layer; those of a colour as one."""
    channels = OpenEXR.File(str(path)).parts[0].channels.items()
    return {name.removeprefix("ViewLayer."): held.pixels.astype(np.float32) for name, held in channels}


@pytest.fixture(scope="module")
def frames(shared_data: Path) -> Path:
    return shared_data / "frames" / "blender-still"


@pytest.fixture(scope="module")
def views(frames: Path) -> list[GBufferView]:
    about = json.loads((frames / "transforms.json").read_text())
    side, found = about["w"], []
    focal = 0.5 * side / np.tan(about["camera_angle_x"] / 2)
    for frame in about["frames"]:
        to_world = opengl_to_opencv(np.array(frame["transform_matrix"]))
        camera = Camera(focal, focal, side / 2, side / 2, side, side, np.linalg.inv(to_world))
        seen = layers(frames / frame["file_path"])
        position, normal = (
            np.stack([seen[f"{n}.{axis}"] for axis in "XYZ"], -1) for n in ("Position", "Normal")
        )
        valid = seen["Depth.Z"] < 1e9
        found.append(
            GBufferView(
                camera, position, np.where(valid[..., None], normal, [0, 0, 1]),
                np.clip(seen["base_color"][..., :3], 0, 1), np.clip(seen["roughness.X"], 0, 1),
                np.clip(seen["metallic.X"], 0, 1), None, valid, np.rint(seen["IndexOB.X"]).astype(int),
            )
        )  # fmt: skip
    return found


@pytest.fixture(scope="module")
def surfels(views: list[GBufferView]) -> GaussianScene:
    return surfels_from_gbuffers(views, count=40_000)


@pytest.mark.parametrize("quality", ["preview", "final"])
@pytest.mark.parametrize("number", [0, 1])
def test_lit_of_blenders_frames_is_cycles_by_object(
    frames: Path,
    shared_data: Path,
    views: list[GBufferView],
    surfels: GaussianScene,
    number: int,
    quality: str,
) -> None:
    """0.91 to 1.08 with Mitsuba's ``principled``; unclamped, Cycles is 1.01 to 1.02 of these frames.

    The ball is metal, of roughness 0.38: what is missing there is split-sum's.
    Edges of the box mirror no lamp that its faces do not: in the studio it is 0.93 in a preview, 0.96 before.
    """
    light = json.loads((frames / "transforms.json").read_text())["lights"][number]
    turn = 90 - light["mapping_rotation_z_deg"]  # Blender looks up at u = 0.5 - atan2(y, x) / 2 pi
    environment = EnvironmentMap.load(shared_data / "hdri" / light["environment"], turn)
    lit = Relighter(surfels, PREVIEW if quality == "preview" else FINEST, proxy="never").under(environment)
    sums = {name: np.zeros(2) for name in OBJECTS.values()}
    for k in range(0, len(views), 2):
        ours = lit.render(views[k].camera).lit
        (theirs,) = layers(frames / light["folder"] / f"{k:03d}.exr").values()
        for index, name in OBJECTS.items():
            where = views[k].valid & (views[k].object_id == index)
            sums[name] += ours[where].sum(), theirs[..., :3][where].sum()
    ratios = {name: ours / theirs for name, (ours, theirs) in sums.items()}
    print(light["folder"], quality, {name: round(float(ratio), 3) for name, ratio in ratios.items()})
    for name, ratio in ratios.items():
        assert ratio == pytest.approx(1, abs=0.075 if name in ("ball", "box") else 0.055), name

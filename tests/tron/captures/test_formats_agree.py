"""One world point lands on the same pixel through every loader, at full size and reduced."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.captures import Capture, LoadSettings, load_capture
from tron.errors import TronError
from tron.io.video import VideoWriter

TOLERANCE = 1e-3


def nerf_synthetic(folder: Path, photos, write) -> None:
    """One angle, no principal point, names without suffix; so the pixels are square and centred."""
    content = write.transforms(photos, "./train/")
    frames = [{**frame, "file_path": frame["file_path"][:-4]} for frame in content["frames"]]
    angle = 2 * np.arctan(0.5 * write.size[0] / write.intrinsics[0])
    write.json(folder / "transforms_train.json", {"camera_angle_x": angle, "frames": frames})
    write.photos(folder / "train", photos, channels=4)


def per_frame(folder: Path, photos, write) -> None:
    content = write.transforms(photos)
    intrinsics = {key: content.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    content["camera_angle_x"] = 1.0  # a frame's own focal length counts
    content["frames"] = [{**frame, **intrinsics} for frame in content["frames"]]
    write.json(folder / "transforms.json", content)
    write.photos(folder / "images", photos)


def dl3dv(folder: Path, photos, write) -> None:
    """The file speaks of ``images``, the folder has them four times smaller."""
    write.json(folder / "transforms.json", write.transforms(photos, applied=True))
    write.photos(folder / "images_8", photos, size=(12, 8))
    write.photos(folder / "images_4", photos, size=(24, 16))


def nerfstudio(folder: Path, photos, write) -> None:
    content = write.transforms(photos, applied=True)
    write.json(folder / "transforms.json", {**content, "camera_model": "OPENCV", "k1": 0.0, "p1": 0})
    write.photos(folder / "images", photos)


def instant_ngp(folder: Path, photos, write) -> None:
    write.json(folder / "transforms.json", {**write.transforms(photos, "./images/"), "aabb_scale": 4})
    write.photos(folder / "images", photos)


def colmap_binary(folder: Path, photos, write) -> None:
    write.colmap(folder / "sparse" / "0", photos, text=False)
    write.photos(folder / "images", photos)


def colmap_text(folder: Path, photos, write) -> None:
    write.colmap(folder / "colmap" / "sparse" / "0", photos, text=True)
    write.photos(folder / "images_2", photos, size=(48, 32))


def tensoir(folder: Path, photos, write) -> None:
    write.tensoir(folder, photos)


def pinhole(write) -> dict:
    fx, fy, cx, cy = write.intrinsics
    width, height = write.size
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}


def polycam(folder: Path, photos, write) -> None:
    """The corrected poses count."""
    for corrected, shift in (("", 1.0), ("corrected_", 0.0)):
        write.photos(folder / "keyframes" / f"{corrected}images", photos)
        for name, matrix in zip(photos.names, photos.opengl):
            entries = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
            entries["t_03"] += shift
            path = folder / "keyframes" / f"{corrected}cameras" / f"{Path(name).stem}.json"
            write.json(path, {**entries, **pinhole(write), "blur_score": 100, "timestamp": 1})


def record3d(folder: Path, photos, write) -> None:
    quats = Rotation.from_matrix(photos.opengl[:, :3, :3]).as_quat()
    fx, fy, cx, cy = write.intrinsics
    content = {
        "w": write.size[0], "h": write.size[1], "fps": 60, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "poses": np.concatenate([quats, photos.opengl[:, :3, 3]], axis=1).tolist(),
    }  # fmt: skip
    write.json(folder / "metadata", content)
    write.photos(folder / "rgb", replace(photos, names=tuple(f"{n}.png" for n in range(len(photos.names)))))


def metashape(folder: Path, photos, write) -> None:
    """f belongs to y, b1 is what x has more; another component and a photo that was not aligned."""
    fx, fy, cx, cy = write.intrinsics
    width, height = write.size
    calibration = f"<f>{fy}</f><cx>{cx - width / 2}</cx><cy>{cy - height / 2}</cy><b1>{fx - fy}</b1>"
    lines = [
        '<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="3" type="frame">',
        f'<resolution width="{width}" height="{height}"/><calibration class="initial"><f>1</f></calibration>',
        f'<calibration class="adjusted">{calibration}</calibration></sensor></sensors><cameras>',
        '<group id="0">',
        *(
            f'<camera id="{n}" sensor_id="3" component_id="0" label="{Path(name).stem}">'
            f"<transform>{' '.join(map(repr, matrix.ravel().tolist()))}</transform></camera>"
            for n, (name, matrix) in enumerate(zip(photos.names, photos.opencv))
        ),
        "</group></cameras></chunk></document>",
    ]
    (folder / "cameras.xml").write_text("\n".join(lines))
    write.photos(folder / "photos", photos)


def opensfm(folder: Path, photos, write) -> None:
    fx, fy, cx, cy = write.intrinsics
    width, height = write.size
    camera = {
        "projection_type": "brown", "width": width, "height": height,
        "focal_x": fx / width, "focal_y": fy / width,
        "c_x": (cx - width / 2) / width, "c_y": (cy - height / 2) / width,
    }  # fmt: skip
    to_camera = np.linalg.inv(photos.opencv)
    turns = Rotation.from_matrix(to_camera[:, :3, :3]).as_rotvec()
    shots = {
        name: {"rotation": turn.tolist(), "translation": matrix[:3, 3].tolist(), "camera": "v2 phone"}
        for name, turn, matrix in zip(photos.names, turns, to_camera)
    }
    points = {str(n): {"coordinates": p.tolist(), "color": [9, 9, 9]} for n, p in enumerate(photos.points)}
    largest = {"cameras": {"v2 phone": camera}, "shots": shots, "points": points}
    (folder / "opensfm").mkdir()
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps([{"shots": {"x": {}}}, largest]))
    write.photos(folder / "images", photos)


def colmap_rigs(folder: Path, photos, write) -> None:
    """COLMAP 4: two cameras a rig, of which the second stands where the rig says; images say no pose."""
    import pycolmap

    model = pycolmap.Reconstruction()
    width, height = write.size
    poses = [pycolmap.Rigid3d(matrix[:3]) for matrix in np.linalg.inv(photos.opencv)]
    for first in range(0, len(photos.names), 2):
        rig, frame = pycolmap.Rig(rig_id=first + 1), pycolmap.Frame(frame_id=first + 1, rig_id=first + 1)
        sensors = []
        for number in (first + 1, first + 2):
            camera = pycolmap.Camera(
                model="PINHOLE", width=width, height=height, params=write.intrinsics, camera_id=number
            )
            model.add_camera(camera)
            sensors.append(camera.sensor_id)
            frame.add_data_id(pycolmap.data_t(camera.sensor_id, number))
        rig.add_ref_sensor(sensors[0])
        rig.add_sensor(sensors[1], poses[first + 1] * poses[first].inverse())
        frame.rig_from_world = poses[first]
        model.add_rig(rig)
        model.add_frame(frame)
        for number in (first + 1, first + 2):
            model.add_image(
                pycolmap.Image(
                    name=photos.names[number - 1], camera_id=number, image_id=number, frame_id=first + 1
                )
            )
    for frame_id in list(model.frames):
        model.register_frame(frame_id)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(folder / "sparse" / "0")
    write.photos(folder / "images", photos)


def other_case(folder: Path, photos, write) -> None:
    """Poses of a camera's names, photos renamed by a system that heeds no case."""
    shouted = replace(photos, names=tuple(name.upper() for name in photos.names))
    write.colmap(folder / "sparse" / "0", shouted, text=True)
    write.photos(folder / "images", photos)


def realitycapture(folder: Path, photos, write) -> None:
    """Angles of an OpenGL camera that turns about z, x and y; one focal length, in millimetres of film."""
    angles = Rotation.from_matrix(photos.opengl[:, :3, :3]).as_euler("ZXY", degrees=True)
    fx, _, cx, cy = write.intrinsics
    width, height = write.size
    calibration = [fx * 36 / width, (cx - width / 2) / width, (cy - height / 2) / width, *[0] * 6]
    lines = [f"#cameras {len(photos.names)}", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, matrix, (yaw, pitch, roll) in zip(photos.names, photos.opengl, angles):
        numbers = [*matrix[:3, 3], -yaw, pitch, roll, *calibration]
        lines.append(",".join([name, *(repr(float(each)) for each in numbers)]))
    (folder / "registration.csv").write_text("\n".join(lines) + "\n")
    write.photos(folder / "photos", photos)


def stray_scanner(folder: Path, photos, write) -> None:
    quats = Rotation.from_matrix(photos.opencv[:, :3, :3]).as_quat()
    fx, fy, cx, cy = write.intrinsics
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    with VideoWriter(folder / "rgb.mp4", 30, write.size) as video:
        for index, (matrix, quat) in enumerate(zip(photos.opencv, quats)):
            numbers = ", ".join(repr(float(each)) for each in (*matrix[:3, 3], *quat))
            lines.append(f"{100 + index / 30}, {index:06d}, {numbers}")
            video.write(write.picture(index))
    (folder / "odometry.csv").write_text("\n".join(lines))
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")


def scanner_app(folder: Path, photos, write) -> None:
    """Frames between those with a photo have a pose alone."""
    fx, fy, cx, cy = write.intrinsics
    for index, matrix in enumerate(photos.opengl):
        content = {
            "cameraPoseARFrame": matrix.ravel().tolist(),
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "frame_index": 6 * index,
        }
        write.json(folder / f"frame_{6 * index:05d}.json", content)
        write.json(folder / f"frame_{6 * index + 1:05d}.json", content)
        write.save(folder / f"frame_{6 * index:05d}.png", write.picture(index))
    write.json(folder / "info.json", {"device": "iPhone"})


def blender_nerf(folder: Path, photos, write) -> None:
    """The BlenderNeRF add-on, on Windows: both kinds of focal length, sizes as floats, a scale of its box."""
    fx, fy, _, _ = write.intrinsics
    width, height = map(float, write.size)
    frames = write.transforms(photos, "images_train\\")["frames"]
    content = {
        "camera_angle_x": 2 * np.arctan(width / 2 / fx), "camera_angle_y": 2 * np.arctan(height / 2 / fy),
        "fl_x": fx, "fl_y": fy, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "cx": width / 2, "cy": height / 2,
        "w": width, "h": height, "aabb_scale": 4, "frames": frames,
    }  # fmt: skip
    write.json(folder / "transforms_train.json", content)
    write.photos(folder / "images_train", photos, channels=4)


def nerf_capture(folder: Path, photos, write) -> None:
    """The app NeRFCapture: names without a suffix, intrinsics of each frame that win over the file's."""
    content = write.transforms(photos)
    own = {key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    frames = [
        {**own, "file_path": f"images/{n}", "depth_path": f"images/{n}.depth.png", "timestamp": float(n),
         "transform_matrix": frame["transform_matrix"]}
        for n, frame in enumerate(content["frames"])
    ]  # fmt: skip
    content |= {"fl_x": 1.0, "fl_y": 1.0, "cx": 320, "cy": 240, "depth_integer_scale": 1.0, "frames": frames}
    write.json(folder / "transforms.json", content)
    write.photos(folder / "images", replace(photos, names=tuple(f"{n}.png" for n in range(len(frames)))))


PANORAMA = (128, 64)


def panoramas_of(folder: Path, photos, write) -> None:
    for index, (name, matrix) in enumerate(zip(photos.names, photos.opengl)):
        write.save(folder / name, write.panorama(matrix, index, PANORAMA))


def panoramas_of_colmap(folder: Path, photos, write) -> None:
    write.colmap(
        folder / "sparse" / "0",
        photos,
        text=False,
        model="EQUIRECTANGULAR",
        parameters=PANORAMA,
        size=PANORAMA,
    )
    panoramas_of(folder / "images", photos, write)


def panoramas_of_nerfstudio(folder: Path, photos, write) -> None:
    frames = write.transforms(photos)["frames"]
    width, height = PANORAMA
    content = {"camera_model": "EQUIRECTANGULAR", "w": width, "h": height, "fl_x": 64, "fl_y": 64}
    write.json(folder / "transforms.json", {**content, "cx": 64, "cy": 32, "frames": frames})
    panoramas_of(folder / "images", photos, write)


def panoramas_of_metashape(folder: Path, photos, write) -> None:
    width, height = PANORAMA
    lines = [
        '<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="spherical">',
        f'<resolution width="{width}" height="{height}"/></sensor></sensors><cameras>',
        *(
            f'<camera id="{n}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
            f"<transform>{' '.join(map(repr, matrix.ravel().tolist()))}</transform></camera>"
            for n, (name, matrix) in enumerate(zip(photos.names, photos.opencv))
        ),
        "</cameras></chunk></document>",
    ]
    (folder / "cameras.xml").write_text("\n".join(lines))
    panoramas_of(folder / "photos", photos, write)


def panoramas_of_opensfm(folder: Path, photos, write) -> None:
    width, height = PANORAMA
    opensfm(folder, photos, write)
    file = folder / "opensfm" / "reconstruction.json"
    content = json.loads(file.read_text())
    content[1]["cameras"]["v2 phone"] = {"projection_type": "spherical", "width": width, "height": height}
    file.write_text(json.dumps(content))
    panoramas_of(folder / "images", photos, write)


PANORAMAS = [panoramas_of_colmap, panoramas_of_nerfstudio, panoramas_of_metashape, panoramas_of_opensfm]
FORMATS = [
    *(nerf_synthetic, instant_ngp, nerfstudio, per_frame, dl3dv, colmap_binary, colmap_text, tensoir),
    *(colmap_rigs, other_case),
    *(polycam, record3d, metashape, opensfm),
    *(realitycapture, stray_scanner, scanner_app, blender_nerf, nerf_capture),
]


@pytest.mark.parametrize("downscale", [1, 2, 3.7])
@pytest.mark.parametrize("layout", FORMATS, ids=lambda layout: layout.__name__)
def test_a_world_point_lands_on_the_same_pixel(
    tmp_path: Path, photos, write, layout, downscale: float
) -> None:
    layout(tmp_path, photos, write)
    capture = load_capture(tmp_path, LoadSettings(downscale=downscale))
    assert not capture.skipped
    fx, fy, cx, cy = write.intrinsics
    width, height = write.size
    intrinsics = {
        "nerf_synthetic": (fx, fx, width / 2, height / 2),
        "realitycapture": (fx, fx, cx, cy),
        "blender_nerf": (fx, fy, width / 2, height / 2),
        "tensoir": (0.5 * width / np.tan(0.4), 0.5 * width / np.tan(0.4), width / 2, height / 2),
    }.get(layout.__name__, (fx, fy, cx, cy))
    order = in_order(capture, layout)
    assert len(order) == len(photos.names)
    for index, view in enumerate(order):
        pixels, depth = view.camera.project(photos.points)
        size = (view.camera.width, view.camera.height)
        expected = photos.pixels(index, size, intrinsics)
        assert (depth > 0).all()
        assert np.abs(pixels - expected).max() < TOLERANCE
        assert view.read().shape == (size[1], size[0], 3)
        assert view.read()[..., 2].mean() == pytest.approx(index / 16, abs=0.01)  # and it is its own image


@pytest.mark.parametrize("layout", [*FORMATS, *PANORAMAS], ids=lambda layout: layout.__name__)
def test_poses_come_back_from_every_format(tmp_path: Path, photos, write, layout) -> None:
    layout(tmp_path, photos, write)
    found = [view.camera.camera_to_world for view in in_order(load_capture(tmp_path), layout)]
    np.testing.assert_allclose(found, photos.opencv, atol=1e-6)


@pytest.mark.parametrize("downscale", [1, 2.5])
@pytest.mark.parametrize("layout", PANORAMAS, ids=lambda layout: layout.__name__)
def test_every_pixel_of_a_panorama_shows_its_direction(
    tmp_path: Path, photos, write, layout, downscale: float
) -> None:
    layout(tmp_path, photos, write)
    capture = load_capture(tmp_path, LoadSettings(downscale=downscale))
    assert not capture.skipped
    assert len(capture.views) == 6 * len(photos.names)
    for index, view in enumerate(capture.views):
        seen = view.read()
        assert np.abs(seen[..., :2] - (0.5 + 0.5 * view.camera.rays()[..., :2])).max() < 0.01
        assert seen[..., 2] == pytest.approx(index // 6 / 16, abs=0.003)
        assert view.camera.fov_deg == pytest.approx(90)


def in_order(capture: Capture, layout) -> list:
    """Views in the order of the cameras: TensoIR's last three are its test views; the front of a panorama."""
    if layout in PANORAMAS:
        return [view for view in capture.views if view.name.endswith("/front")]
    if layout is not tensoir:
        return list(capture.views)
    return [*capture.train_views, *capture.test_views]


@pytest.mark.parametrize("layout", [nerfstudio, dl3dv], ids=lambda layout: layout.__name__)
def test_the_transform_takes_the_files_world_to_the_captures(tmp_path: Path, photos, write, layout) -> None:
    layout(tmp_path, photos, write)
    transform = load_capture(tmp_path).transform
    content = write.transforms(photos, applied=True)
    applied = np.array(content["applied_transform"])
    of_file = content["applied_scale"] * (photos.points @ applied[:, :3].T + applied[:, 3])
    assert np.abs(of_file @ transform[:3, :3].T + transform[:3, 3] - photos.points).max() < 1e-9


def test_max_side_reduces_to_the_longer_side_and_never_enlarges(tmp_path: Path, photos, write) -> None:
    instant_ngp(tmp_path, photos, write)
    small = load_capture(tmp_path, LoadSettings(max_side=48)).views[0].camera
    assert (small.width, small.height) == (48, 32)
    large = load_capture(tmp_path, LoadSettings(max_side=500)).views[0].camera
    assert (large.width, large.height) == write.size


def test_a_path_traced_folder_is_recognised_and_read_as_it_is(tmp_path: Path, photos, write) -> None:
    from tron.captures.folder import write_capture

    instant_ngp(tmp_path / "photos", photos, write)
    original = load_capture(tmp_path / "photos")
    write_capture(tmp_path / "traced", original)
    for path in (tmp_path / "traced", tmp_path / "traced" / "transforms.json"):
        capture = load_capture(path, LoadSettings(up=(0, 2, 0)))
        assert capture.test == original.test
        assert np.allclose(capture.up, (0, 1, 0))
        for index, view in enumerate(capture.views):
            assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index)).max() < TOLERANCE
    with pytest.raises(TronError, match="cannot be reduced"):
        load_capture(tmp_path / "traced", LoadSettings(downscale=2))

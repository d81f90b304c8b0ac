"""Recordings of phones: frames of the video with their own poses, depth, and one line for each bad one."""

import json
from pathlib import Path

import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.errors import TronError
from tron.io.video import VideoWriter

HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
COUNT = 12


def recorded(folder: Path, write, rows: list[str] | None = None, header: str | None = HEADER) -> Path:
    """A recording whose frame n stands at x = n and is n / 16 blue."""
    if rows is None:
        rows = [f"{n / 30}, {n:06d}, {n}, 0, 0, 0, 0, 0, 1" for n in range(COUNT)]
    with VideoWriter(folder / "rgb.mp4", 30, write.size) as video:
        for n in range(COUNT):
            video.write(write.picture(n))
    (folder / "odometry.csv").write_text("\n".join([*([] if header is None else [header]), *rows]))
    (folder / "camera_matrix.csv").write_text("90.0, 0, 48.0\n0, 91.0, 32.0\n0, 0, 1.0")
    return folder


def blue(view) -> float:
    return 16 * float(view.read()[..., 2].mean())


def test_frames_keep_their_own_poses_when_some_are_taken(tmp_path: Path, write) -> None:
    capture = load_capture(recorded(tmp_path, write), LoadSettings(frames=4))
    assert len(capture.views) == 4
    for view in capture.views:
        x = view.camera.position[0]
        assert view.name == f"{round(x):06d}"
        assert blue(view) == pytest.approx(x, abs=0.3)
        assert (view.camera.fx, view.camera.fy) == (90, 91)
    assert np.allclose(capture.up, (0, 1, 0))
    thirds = [int(view.camera.position[0]) // 3 for view in capture.views]
    assert thirds == [0, 1, 2, 3]


def test_frames_are_kept_until_the_recording_or_their_number_changes(tmp_path: Path, write) -> None:
    folder = recorded(tmp_path, write) / "rgb_frames" / "frames"
    load_capture(tmp_path, LoadSettings(frames=4))
    before = {each.name: each.stat().st_mtime_ns for each in folder.iterdir()}
    load_capture(tmp_path, LoadSettings(frames=4))
    assert {each.name: each.stat().st_mtime_ns for each in folder.iterdir()} == before
    assert len(load_capture(tmp_path, LoadSettings(frames=6)).views) == 6
    taken, table = load_capture(tmp_path, LoadSettings(frames=6)).views[1].name, tmp_path / "odometry.csv"
    rows = [row for row in table.read_text().splitlines() if f" {taken}," not in row]
    table.write_text("\n".join(rows))
    assert taken not in [view.name for view in load_capture(tmp_path, LoadSettings(frames=6)).views]


def test_intrinsics_of_a_frame_win_and_the_oldest_tables_have_no_header(tmp_path: Path, write) -> None:
    rows = [f"0, {n:06d}, {n}, 0, 0, 0, 0, 0, 1, {100 + n}, 101, 47, 33, , " for n in range(COUNT)]
    newest = recorded(
        tmp_path, write, rows, f"{HEADER}, fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    )
    assert [view.camera.fx for view in load_capture(newest).views] == [100 + n for n in range(COUNT)]
    (tmp_path / "camera_matrix.csv").unlink()
    assert len(load_capture(newest).views) == COUNT
    oldest = recorded(tmp_path, write, [f"{n}, 0, 0, 0, 0, 0, 1" for n in range(COUNT)], header=None)
    assert [view.camera.position[0] for view in load_capture(oldest).views] == list(range(COUNT))


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_depth_in_millimetres_is_found_by_the_frame(tmp_path: Path, write, suffix: str) -> None:
    recorded(tmp_path, write)
    for n in range(COUNT):
        path, depth = tmp_path / "depth" / f"{n:06d}.{suffix}", np.full((16, 24), 1000 + n, np.uint16)
        path.parent.mkdir(exist_ok=True)
        np.save(path, depth) if suffix == "npy" else write.save(path, depth)
    for view in load_capture(tmp_path, LoadSettings(frames=3)).views:
        along = view.read("depth") * (view.camera.rays() @ view.camera.forward)
        assert along == pytest.approx(1 + view.camera.position[0] / 1000, abs=1e-5)


def test_bad_rows_are_left_out_with_their_reasons(tmp_path: Path, write) -> None:
    rows = [f"0, {n:06d}, {n}, 0, 0, 0, 0, 0, 1" for n in range(COUNT)]
    rows[2] = "0, 000002, nan, 0, 0, 0, 0, 0, 1"
    rows[3] = "0, 000003, 3, 0, 0, 0, 0, 0, 0.2"
    rows[-1] = rows[-1][:14]
    del rows[5]
    capture = load_capture(recorded(tmp_path, write, rows))
    assert [view.name for view in capture.views] == [f"{n:06d}" for n in (0, 1, 4, 6, 7, 8, 9, 10)]
    assert "NaN" in capture.skipped["000002"]
    assert "unit quaternion" in capture.skipped["000003"]
    assert "cut short" in capture.skipped["000011"]


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("odometry.csv", "time, place\n0, 1\n", "rows are not x, y, z, qx"),
        ("odometry.csv", "", "rows are not x, y, z, qx"),
        ("odometry.csv", HEADER, "holds no frame"),
        ("odometry.csv", f"{HEADER}\n0, -1, 0, 0, 0, 0, 0, 0, 1", "row 1 is of frame -1"),
        ("odometry.csv", f"{HEADER}\n0, 1e300, 0, 0, 0, 0, 0, 0, 1", "row 1 is of frame 1e"),
        ("camera_matrix.csv", "1, 2\n3, 4", "not the 3 x 3 matrix"),
        ("camera_matrix.csv", "90, 0, 48\n0, nan", "not a matrix"),
        ("camera_matrix.csv", None, "no camera_matrix.csv"),
        ("rgb.mp4", "no video", "not a readable video"),
    ],
)
def test_a_damaged_recording_is_one_line(tmp_path: Path, write, name: str, content, line: str) -> None:
    recorded(tmp_path, write)
    (tmp_path / name).unlink() if content is None else (tmp_path / name).write_text(content)
    with pytest.raises(TronError, match=line) as caught:
        load_capture(tmp_path)
    assert len(str(caught.value).splitlines()) == 1


def scanned(folder: Path, write, count: int = 4) -> Path:
    """An export of 3D Scanner App; camera n stands at x = n."""
    for n in range(count):
        pose = np.eye(4)
        pose[0, 3] = n
        frame = {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": [90, 0, 48, 0, 91, 32, 0, 0, 1]}
        write.json(folder / f"frame_{n:05d}.json", frame)
        write.save(folder / f"frame_{n:05d}.png", write.picture(n))
        write.save(folder / f"depth_{n:05d}.png", np.full((16, 24), 2000 + n, np.uint16))
        write.save(folder / f"conf_{n:05d}.png", np.full((16, 24), 2, np.uint8))
    return folder


def test_scans_have_depth_and_only_their_photos_are_views(tmp_path: Path, write) -> None:
    write.save(tmp_path / "thumb_00.png", write.picture(9))
    capture = load_capture(scanned(tmp_path, write))
    assert [view.name for view in capture.views] == [f"frame_{n:05d}" for n in range(4)]
    for n, view in enumerate(capture.views):
        along = view.read("depth") * (view.camera.rays() @ view.camera.forward)
        assert along == pytest.approx(2 + n / 1000, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"cameraPoseARFrame": [1, 0, 0]}, "not 16 numbers"),
        ({"cameraPoseARFrame": [float("nan")] * 16}, "NaN"),
        ({"intrinsics": "none"}, "not 9 numbers"),
        ({"intrinsics": [0] * 9}, "focal length is 0"),
        ({"intrinsics": [10**400] * 9}, "not 9 numbers"),
        (None, "not readable as JSON"),
    ],
)
def test_a_bad_frame_of_a_scan_is_left_out_with_its_reason(
    tmp_path: Path, write, change, reason: str
) -> None:
    file = scanned(tmp_path, write) / "frame_00002.json"
    text = file.read_text()
    file.write_text(text[: len(text) // 2] if change is None else json.dumps(json.loads(text) | change))
    capture = load_capture(tmp_path)
    assert list(capture.skipped) == ["frame_00002"]
    assert reason in capture.skipped["frame_00002"]


def test_a_scan_without_photos_is_one_line(tmp_path: Path, write) -> None:
    for each in scanned(tmp_path, write).glob("*.png"):
        each.unlink()
    with pytest.raises(TronError, match="no photo lies beside its frames"):
        load_capture(tmp_path)

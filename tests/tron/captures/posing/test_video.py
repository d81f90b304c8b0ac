"""A video becomes photos: the sharpest of each interval, upright; one without motion is refused."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from tron.captures import LoadSettings, load_capture
from tron.captures.photos.video_frames import sharpness
from tron.captures.posing import video as module
from tron.captures.posing.video import (
    VideoSettings,
    _kept_frames,
    choose_frames,
    motion,
    read_video,
)
from tron.errors import TronError
from tron.io.video import VideoWriter, frames_of
from tron.seeds import generator

SIZE = (96, 64)
FPS = 24


def texture() -> np.ndarray:
    """(64, 400, 3) uint8, blobs of a few pixels and of one hue, since videos keep few colours."""
    noise = generator(0, "video").random((16, 100)).astype(np.float32)
    grey = cv2.resize(noise, (400, 64), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    return np.round(255 * grey[..., None] * (1.0, 0.9, 0.8)).astype(np.uint8)


def walk(count: int = 24, speed: int = 4) -> list[np.ndarray]:
    """Frames of a walk along the texture; every fourth is sharp."""
    frames = []
    for index in range(count):
        frame = texture()[:, speed * index : speed * index + SIZE[0]]
        frames.append(frame if index % 4 == 2 else cv2.GaussianBlur(frame, (0, 0), 2.5))
    return frames


def film(path: Path, frames: list[np.ndarray]) -> Path:
    with VideoWriter(path, FPS, SIZE) as video:
        for frame in frames:
            video.write(frame)
    return path


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path: Path) -> None:
    frames = walk()
    chosen = choose_frames(film(tmp_path / "a.mp4", frames), 6)
    assert len(chosen) == 6
    for index, found in enumerate(chosen):
        error = [np.abs(found.astype(float) - frame).mean() for frame in frames]
        assert np.argmin(error) == 4 * index + 2
        assert min(error) < 8  # what 4:2:0 leaves of such texture; the next frame is 44 off
    assert all(sharpness(cv2.cvtColor(found, cv2.COLOR_RGB2GRAY)) > 100 for found in chosen)


def test_all_frames_are_taken_of_a_video_that_has_fewer(tmp_path: Path) -> None:
    assert len(choose_frames(film(tmp_path / "a.mp4", walk(5)), 120)) == 5


def test_motion_is_the_share_of_the_width_that_the_picture_moves_by() -> None:
    frames = [texture()[:, start : start + SIZE[0]] for start in (0, 2, 5, 6)]
    assert motion(frames) == pytest.approx(3 / SIZE[0], rel=0.05)
    noise = generator(1, "noise").normal(0, 3, (*SIZE[::-1], 3))
    still = [frames[0], np.clip(frames[0] + noise, 0, 255).astype(np.uint8)]
    assert motion(still) < 0.003


def test_a_video_without_motion_is_one_line(tmp_path: Path) -> None:
    path = film(tmp_path / "still.mp4", [walk(3, 0)[2]] * 12)
    with pytest.raises(TronError, match="nothing moves in the video") as caught:
        load_capture(path, LoadSettings(frames=6, workspace=tmp_path / "work"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "work" / "frames").exists()


def test_frames_are_those_of_the_video_that_is_there(tmp_path: Path) -> None:
    """Kept while the video stays, made anew when another one has its name or other frames are wanted."""
    path, work = film(tmp_path / "a.mp4", walk()), tmp_path / "work"

    def frames(count: int) -> dict[str, bytes]:
        return {file.name: file.read_bytes() for file in _kept_frames(path, count, work).iterdir()}

    first = frames(6)
    marked = work / "frames" / "00000.jpg"
    marked.write_bytes(b"kept")
    assert frames(6)["00000.jpg"] == b"kept"
    assert len(frames(4)) == 4 + 1
    assert frames(6) == first
    film(path, walk()[::-1])
    assert frames(6)["00000.jpg"] not in (b"kept", first["00000.jpg"])


@pytest.mark.parametrize(("asked", "taken"), [("auto", "sequential"), ("exhaustive", "exhaustive")])
def test_neighbours_in_time_are_matched_unless_another_way_is_asked_for(
    tmp_path: Path, monkeypatch, asked, taken
) -> None:
    posed = []
    monkeypatch.setattr(module, "pose_photos", lambda folder, settings: posed.append((folder, settings)))
    path = film(tmp_path / "a.mp4", walk())
    read_video(path, VideoSettings(frames=6, matching=asked, workspace=tmp_path / "work"))
    [(folder, settings)] = posed
    assert settings.matching == taken
    assert len(list(folder.glob("*.jpg"))) == 6


def test_a_phones_video_is_turned_upright(tmp_path: Path) -> None:
    """Phones store frames on their side, with a matrix that turns them."""
    plain, turned = film(tmp_path / "a.mp4", walk(2)), tmp_path / "b.mp4"
    data = bytearray(plain.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 4 * 5 + 8 + 4 * 2  # behind version, times, ids, layer and volume
    one, zero = (1 << 16).to_bytes(4, "big"), bytes(4)
    minus, unit = (-(1 << 16)).to_bytes(4, "big", signed=True), (1 << 30).to_bytes(4, "big")
    assert bytes(data[at : at + 36]) == one + zero * 3 + one + zero * 3 + unit
    data[at : at + 36] = zero + one + zero + minus + zero * 4 + unit  # a quarter turn
    turned.write_bytes(bytes(data))
    stored, upright = (next(iter(frames_of(path))).rgb() for path in (plain, turned))
    assert upright.shape == (SIZE[0], SIZE[1], 3)
    assert np.array_equal(np.rot90(stored, -1), upright)


@pytest.mark.parametrize("damage", ["text", "sound", "cut"])
def test_a_file_that_is_no_video_is_one_line(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "a.mp4"
    if damage == "sound":
        with av.open(str(path), "w") as container:
            stream = container.add_stream("aac", rate=8000)
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate = 8000
            container.mux([*stream.encode(frame), *stream.encode(None)])  # pyright: ignore
    else:
        film(path, walk())
        path.write_bytes(b"no video" if damage == "text" else path.read_bytes()[:3000])
    with pytest.raises(TronError, match=r"a.mp4") as caught:
        load_capture(path, LoadSettings(workspace=tmp_path / "work"))
    assert "\n" not in str(caught.value)


@pytest.mark.long
def test_frames_of_a_walk_around_the_fox_are_posed(shared_data: Path, tmp_path: Path) -> None:
    """Twelve photos as a video of twelve sharp frames, each between blurred ones."""
    folder = shared_data / "captures" / "fox" / "images"
    if not folder.is_dir():
        pytest.skip(f"no real capture: {folder} is absent")
    frames = []
    for path in sorted(folder.iterdir())[:12]:
        with Image.open(path) as photo:
            picture = np.asarray(photo.resize((540, 960), Image.Resampling.BOX))
        frames += [cv2.GaussianBlur(picture, (0, 0), 4), picture]
    with VideoWriter(tmp_path / "fox.mp4", FPS, (540, 960)) as video:
        for frame in frames:
            video.write(frame)
    settings = LoadSettings(frames=12, workspace=tmp_path / "work", threads=1, downscale=4)
    capture = load_capture(tmp_path / "fox.mp4", settings)
    assert len(capture.views) >= 11
    assert (capture.views[0].camera.width, capture.views[0].camera.height) == (135, 240)
    assert capture.points is not None
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "work" / "frames").iterdir()}
    load_capture(tmp_path / "fox.mp4", settings)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "work" / "frames").iterdir()}

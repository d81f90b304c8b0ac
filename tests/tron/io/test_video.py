"""Videos: frames, colours and rate survive; a failed video leaves nothing."""

from pathlib import Path

import av
import numpy as np
import pytest

from tron.errors import TronError
from tron.io.video import VideoWriter


def gradient(height: int = 48, width: int = 64, shift: float = 0.0) -> np.ndarray:
    x, y = np.linspace(0, 1, width), np.linspace(0, 1, height)[:, None]
    return np.stack(np.broadcast_arrays(x, y, 0.5 + 0.5 * np.sin(6 * (x + y + shift))), axis=-1)


def test_frames_come_back_in_order_and_close(tmp_path: Path, read_video):
    frames = [gradient(shift=shift) for shift in np.linspace(0, 1, 9)]
    with VideoWriter(tmp_path / "a.mp4", 24, (64, 48)) as video:
        for frame in frames:
            video.write(frame)
    read = read_video(tmp_path / "a.mp4") / 255.0
    assert read.shape == (9, 48, 64, 3)
    errors = np.array([[np.abs(a - b).mean() for b in frames] for a in read])
    assert (errors.argmin(axis=1) == np.arange(9)).all()
    assert errors.diagonal().max() < 0.02


@pytest.mark.parametrize(
    "rgb", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, 0.5, 0.5), (0.2, 0.7, 0.4), (1, 1, 1)]
)
def test_flat_colours_are_kept(tmp_path: Path, rgb: tuple, read_video):
    """A wrong YUV matrix (BT.601 for 709) shifts pure green by 20 levels, a wrong range greys by 16."""
    with VideoWriter(tmp_path / "a.mp4", 24, (32, 32)) as video:
        video.write(np.broadcast_to(np.array(rgb, float), (32, 32, 3)))
    assert np.abs(read_video(tmp_path / "a.mp4")[0, 16, 16] - 255.0 * np.array(rgb)).max() <= 3


def test_stream_says_what_it_is(tmp_path: Path):
    with VideoWriter(tmp_path / "a.mp4", 29.97, (32, 32)) as video:
        for _ in range(5):
            video.write(np.zeros((32, 32, 3), np.uint8))
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate is not None
        assert float(stream.average_rate) == pytest.approx(29.97, rel=1e-4)
        frame = next(container.decode(video=0))
        assert (frame.colorspace, frame.color_range) == (1, 1)  # BT.709, limited range


def test_odd_sizes_gain_a_repeated_edge(tmp_path: Path, read_video):
    with VideoWriter(tmp_path / "a.mp4", 24, (31, 17)) as video:
        video.write(gradient(17, 31))
    read = read_video(tmp_path / "a.mp4")[0] / 255.0
    assert read.shape == (18, 32, 3)
    assert np.abs(read[:17, :31] - gradient(17, 31)).mean() < 0.04


def test_floats_and_bytes_mean_the_same_and_bytes_repeat(tmp_path: Path):
    frame = np.round(gradient() * 255).astype(np.uint8)
    for name, picture in (("a.mp4", frame), ("b.mp4", frame / 255), ("c.mp4", frame)):
        with VideoWriter(tmp_path / name, 24, (64, 48)) as video:
            video.write(picture)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "c.mp4").read_bytes()


def write(path: Path, *frames: np.ndarray, fail: bool = False) -> None:
    with VideoWriter(path, 24, (64, 48)) as video:
        for frame in frames:
            video.write(frame)
        if fail:
            raise RuntimeError


def test_failures_leave_nothing(tmp_path: Path):
    with pytest.raises(RuntimeError):
        write(tmp_path / "a.mp4", gradient(), fail=True)
    with pytest.raises(TronError, match="no frames"):
        write(tmp_path / "a.mp4")
    with pytest.raises(TronError, match="shape"):
        write(tmp_path / "a.mp4", gradient(), gradient(40, 64))
    assert not list(tmp_path.iterdir())

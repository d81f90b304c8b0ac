"""Frames that wait on disk come back as a shard would have stored them."""

import resource
from pathlib import Path

import numpy as np
import pytest

from datagen.dataset.spool import Spool, ViewSpool, first_bad_value, stored
from tron.cameras import Camera
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.gaussians.initialize import GBufferView
from tron.io.images import decode_exr, encode_exr
from tron.seeds import generator


def frame(number: int) -> dict[str, np.ndarray]:
    rng = generator(1, "spool", number)
    return {
        "rgb": rng.lognormal(0, 3, (5, 7, 3)).astype(np.float32),
        "mask": rng.random((5, 7)).astype(np.float32),
    }


def test_frames_come_by_time_and_leave_by_clip(tmp_path):
    with Spool(tmp_path / "new", clips=3) as spool:
        for i in range(2):
            for clip in range(3):
                spool.add(clip, frame(10 * clip + i))
        assert not list((tmp_path / "new").iterdir()), "the file has no name to be left under"
        for number in (2, 0, 1):
            clip = spool.clip(number)
            assert len(clip) == 2
            for i, found in enumerate(clip):
                given = frame(10 * number + i)
                assert set(found) == set(given)
                for name, image in given.items():
                    assert found[name].dtype == np.float32
                    assert found[name].shape == image.shape
                    np.testing.assert_array_equal(found[name], stored(name, image).astype(np.float32))
                    np.testing.assert_array_equal(clip[i][name], found[name])
            assert [set(part) for part in clip[1:]] == [{"rgb", "mask"}]


def test_a_shard_stores_what_comes_back_bit_by_bit(tmp_path):
    image = frame(0)["rgb"]
    image[0, 0] = 1e6, 65504.0, 1e-9
    with Spool(tmp_path, clips=1) as spool:
        spool.add(0, {"rgb": image})
        back = spool.clip(0)[0]["rgb"]
    assert encode_exr(back, half=True) == encode_exr(image, half=True)
    np.testing.assert_array_equal(decode_exr(encode_exr(image, half=True)), back)


def test_values_that_are_not_finite_are_still_found(tmp_path):
    image = np.ones((2, 2, 3), np.float32)
    image[0, 0], image[1, 1, 0] = (np.inf, 1e30, -np.inf), np.nan
    with Spool(tmp_path, clips=1) as spool:
        spool.add(0, {"rgb": image})
        assert first_bad_value(spool.clip(0)) == "frame 0: rgb has 3 values that are not finite"


@pytest.mark.parametrize("scale", [1, 20], ids=["in the buffer", "past it"])
def test_a_full_disk_is_one_line(tmp_path: Path, scale: int):
    """A file that may not grow stands for the disk, for frames that a buffer holds and for large ones."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        said = pytest.raises(TronError, match="frames cannot be held: File too large")
        with said, Spool(tmp_path, clips=1) as spool:
            for _ in range(200):
                spool.add(0, {"rgb": np.ones((5 * scale, 7, 3), np.float32)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_views_come_back_bit_by_bit(tmp_path):
    rng = generator(1, "view spool")
    camera = Camera.look_at((4, 0, 2), (0, 0, 0), width=7, height=5, fov_deg=50)
    normal = rng.normal(size=(5, 7, 3))
    seen = GBufferView(
        camera=camera,
        position=rng.random((5, 7, 3), np.float32),
        normal=(normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
        base_color=rng.random((5, 7, 3), np.float32),
        roughness=rng.random((5, 7), np.float32),
        metallic=rng.random((5, 7), np.float32),
        rgb=None,
        valid=rng.random((5, 7)) < 0.7,
        object_id=np.ones((5, 7), np.int32),
    )
    with ViewSpool(tmp_path / "new") as spool:
        assert list(spool.passing([seen, seen])) == [seen, seen]
        assert not list((tmp_path / "new").iterdir())
        first, second = spool.views()
        for name in ("base_color", "roughness", "metallic", "normal"):
            there = getattr(seen, name)[seen.valid]
            np.testing.assert_array_equal(second.read(name)[seen.valid], there)
            assert not first.read(name)[~seen.valid].any()
        np.testing.assert_array_equal(first.read("mask"), seen.valid)
        np.testing.assert_array_equal(first.read(), linear_to_srgb(first.read("base_color")))

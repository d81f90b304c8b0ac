"""Scenes under two lights at once: one convex combination of the same frames for all buffers."""

import pytest
import torch

from train.examples.sources import CachedSplit, Draw, IndexedSplit, OtherLights
from tron import seeds
from tron.shards import ClipStore
from tron.shards.schema import TARGET

MEMBERS = ("pbr", "irradiance", TARGET)


@pytest.fixture(scope="module")
def lit_twice(make_dataset, tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("lights"), {"train": 3}, lights=3)


def drawn(folder, kind: type[IndexedSplit] = CachedSplit, mix=1.0, members=MEMBERS, frames=2):
    source = kind(ClipStore(folder, "train"), "train", members, 0, mix)
    return [source.sample(Draw(n, seeds.generator(0, "draw", n), frames)) for n in range(12)]


def weight(mixed: torch.Tensor, one: torch.Tensor, two: torch.Tensor) -> float:
    """w of mixed = w one + (1 - w) two by least squares."""
    difference = one - two
    return float(((mixed - two) * difference).sum() / difference.square().sum())


def test_all_buffers_are_the_same_mixture_of_two_lights_of_one_scene(lit_twice):
    plain = drawn(lit_twice, mix=0.0)
    store = ClipStore(lit_twice, "train")
    clips = {store.key(n): CachedSplit(store, "train", MEMBERS, 0)._decoded[n] for n in range(len(store))}
    passes = CachedSplit(store, "train", MEMBERS, 0)._passes
    shares = []
    for number, (one, mixed) in enumerate(zip(plain, drawn(lit_twice))):
        key = store.key(passes.clip(number))
        start = next(
            s for s in range(5) if torch.equal(clips[key].buffers[TARGET][:, s : s + 2], one.buffers[TARGET])
        )
        explained = []
        for other, clip in clips.items():
            if other == key:
                continue
            parts = {name: video[:, start : start + 2] for name, video in clip.buffers.items()}
            w = weight(mixed.buffers[TARGET], one.buffers[TARGET], parts[TARGET])
            if all(
                torch.allclose(mixed.buffers[n], w * one.buffers[n] + (1 - w) * parts[n], atol=1e-5)
                for n in MEMBERS
            ):
                explained.append((other, w))
        ((other, w),) = explained
        assert other.rpartition("-")[0] == key.rpartition("-")[0]
        assert 0 <= w <= 1
        shares.append(w)
    assert max(shares) - min(shares) > 0.3


def test_memory_and_disk_mix_alike_and_the_ratio_is_the_share_that_is_mixed(lit_twice):
    plain = drawn(lit_twice, mix=0.0)
    for ratio, fewest, most in ((1.0, 12, 12), (0.5, 2, 10)):
        cached, indexed = (drawn(lit_twice, kind, ratio) for kind in (CachedSplit, IndexedSplit))
        for a, b in zip(cached, indexed):
            assert all(torch.equal(a.buffers[name], b.buffers[name]) for name in MEMBERS)
        changed = sum(not torch.equal(a.buffers[TARGET], b.buffers[TARGET]) for a, b in zip(plain, cached))
        assert fewest <= changed <= most


def test_scenes_with_one_light_and_photographs_stay_as_they_are(make_dataset, dataset, tmp_path):
    photos = make_dataset(tmp_path / "photos", {"train": 3}, lights=2, spaces={TARGET: "display"})
    for folder in (dataset, photos):
        for a, b in zip(drawn(folder, mix=0.0), drawn(folder)):
            assert all(torch.equal(a.buffers[name], b.buffers[name]) for name in MEMBERS)


def test_joined_splits_mix_lights_within_their_own():
    """Photos and relit views of a capture have the same keys but for their lights, and other cameras."""
    keys = [
        ("photos", "a-l0-c0000"),
        ("photos", "a-l0-c0001"),
        ("relit", "a-l1-c0000"),
        ("relit", "a-l2-c0000"),
    ]

    class Clips:
        def __len__(self):
            return len(keys)

        def key(self, number: int) -> str:
            return keys[number][1]

        def split_of(self, number: int) -> str:
            return keys[number][0]

    lights = OtherLights(Clips(), 1.0, lambda *_: None)  # type: ignore[arg-type]
    assert sorted(map(sorted, lights._places.values())) == [[0], [1], [2, 3]]


def test_views_of_relit_captures_are_mixed_with_the_same_view_under_other_lights(make_dataset, tmp_path):
    folder = make_dataset(tmp_path, {"train": 2}, lights=2, views=3)
    store = ClipStore(folder, "train")
    assert store.key(1) == "train000-l0-c0001"
    for one, mixed in zip(drawn(folder, mix=0.0), drawn(folder)):
        assert not torch.equal(one.buffers[TARGET], mixed.buffers[TARGET])

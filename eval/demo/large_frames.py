"""Large frames of held-out scenes by the checkpoints that ship, which never saw the demo's data."""

from __future__ import annotations

from pathlib import Path

from eval.relighting.baselines import predictions
from eval.relighting.buffers import MEMBERS
from eval.relighting.gallery import Example, middle_frame
from eval.renderer.networks import METHODS, load_networks
from eval.renderer.pictures import comparison
from tron.neural.shipped import installed
from tron.report.page import Section, Text
from tron.shards.reader import read_clips


def large_frames(dataset: Path) -> list[Section]:
    """One frame of each test scene, under another light than the scene's before: guidance, networks, truth.

    Empty where this installation came without checkpoints.

    Raises:
        TronError: the dataset has no test split or is damaged.
    """
    files = installed()
    networks = load_networks({kind: files[kind] for kind in METHODS if kind in files})
    shows = {METHODS[kind]: network.show(1) for kind, network in networks.items()}
    if not networks:
        return []
    examples: dict[str, list[Example]] = {}
    for clip in read_clips(dataset, "test", MEMBERS):
        shown = predictions(clip, shows)["frame"]
        examples.setdefault(clip.meta.scene, []).append(middle_frame(clip, shown, clip.displayed("rgb")))
    chosen = [lights[number % len(lights)] for number, lights in enumerate(examples.values())]
    size = f"{chosen[0].meta.width} x {chosen[0].meta.height}"
    words = (
        f"Frames of {size} pixels of held-out scenes. The networks are those that come with the package "
        "(`checkpoint=pair` and `checkpoint=lit`): they were trained on other scenes, at 128 x 128, and not "
        "here. Each number is the PSNR of that very picture's foreground."
    )
    blocks = [Text(words), *map(comparison, chosen)]
    return [Section("large", "Larger frames, by the renderers that ship", blocks)]

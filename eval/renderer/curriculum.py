"""Stages of a training against distributions: what each stage added, and what it cost elsewhere."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.renderer.frames import FramePsnr, difference_row, frame_psnr
from eval.renderer.networks import TITLES, Network, load_networks
from eval.renderer.settings import Kind
from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.results import Row, mean_row
from tron.errors import TronError
from tron.report.page import Block, Cell, Section, Table, Text

SYNTHETIC, CAPTURES, PHOTOS = "synthetic", "captures", "photos"
PLACES = {
    SYNTHETIC: "synthetic scenes",
    CAPTURES: "captures relit",
    PHOTOS: "photos that captures are made from",
}
"""Distribution that judges -> its heading."""
STAGE_FILE = re.compile(r"(\d+)-([\w-]+)\.safetensors")


@dataclass(frozen=True)
class Curriculum:
    """Findings: (checkpoint, stage's number, distribution) -> PSNR of each frame, single frames all."""

    psnr: Mapping[tuple[Kind, int, str], FramePsnr]
    names: Mapping[tuple[Kind, int], str]

    def rows(self, seed: int) -> Iterator[Row]:
        """PSNR of every stage, what stage 2 gains on captures, and what stage 3 loses on single frames.

        Figures without a checkpoint's name are of the first that was given. The loss is the greatest of
        those on the distributions.
        """
        for (kind, number, place), found in self.psnr.items():
            yield mean_row(f"renderer.{kind}.stage{number}_psnr.{place}", "dB", found, seed)
        kinds: list[Kind] = list(dict.fromkeys([kind for kind, _ in self.names]))
        first = kinds[0]
        for kind in kinds:
            start = "renderer" if kind == first else f"renderer.{kind}"
            yield from self._change(f"{start}.stage2_capture_gain_db", kind, 2, 1, CAPTURES, seed)
            yield from self._change(f"{start}.stage2_photo_gain_db", kind, 2, 1, PHOTOS, seed)
            losses = [
                row
                for place in PLACES
                for row in self._change(
                    f"{start}.stage3_single_frame_loss_db.{place}", kind, 2, 3, place, seed
                )
            ]
            yield from losses
            if losses:
                worst = max(losses, key=lambda row: row.value)
                yield worst.model_copy(update={"metric": f"{start}.stage3_single_frame_loss_db"})

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """A row for each stage, a column for each distribution."""
        places = [place for place in PLACES if any(place == found for _, _, found in self.psnr)]
        rows: list[Sequence[Cell | str]] = []
        for (kind, number), name in self.names.items():
            cells = []
            for place in places:
                found = self.psnr.get((kind, number, place))
                cells.append(row_cell(None if found is None else mean_row("a.b", "dB", found, 0)))
            rows.append([f"{TITLES[kind]}, stage {number} ({name})", *cells])
        scenes = [len({scene for scene, _ in found}) for found in self.psnr.values()]
        caption = "Foreground PSNR of what each stage ended with, single frames."
        blocks: list[Block] = [
            Text(f"Differences of stages are of the same frames. {interval_note(min(scenes))}"),
            Table(caption, ["Stage", *(PLACES[place] for place in places)], rows),
        ]
        return [Section("curriculum", "Stages of the training", blocks)]

    def _change(
        self, metric: str, kind: Kind, number: int, other: int, place: str, seed: int
    ) -> Iterator[Row]:
        ours, others = self.psnr.get((kind, number, place)), self.psnr.get((kind, other, place))
        if ours is not None and others is not None:
            yield difference_row(metric, ours, others, seed)


def stage_files(folder: Path) -> dict[int, tuple[str, Path]]:
    """Number of a stage -> its name and what it ended with, of a folder that tron-train wrote.

    Raises:
        TronError: there are none.
    """
    found = {}
    for path in sorted((folder / "checkpoints").glob("*.safetensors")):
        if name := STAGE_FILE.fullmatch(path.name):
            found[int(name[1])] = (name[2], path)
    if not found:
        raise TronError("no stages of a training", folder / "checkpoints", "give a folder of tron-train")
    return dict(sorted(found.items()))


def measure_curriculum(training: Mapping[Kind, Path], judges: Mapping[str, tuple[Path, str]]) -> Curriculum:
    """Judge every stage.

    Args:
        training: folder of each checkpoint's training.
        judges: name of a distribution -> data set and split.

    Raises:
        TronError: a folder holds no stages, or a file no renderer.
    """
    names: dict[tuple[Kind, int], str] = {}
    networks: dict[tuple[Kind, int], Network] = {}
    for kind, folder in training.items():
        for number, (name, path) in stage_files(folder).items():
            names[kind, number] = name
            networks[kind, number] = load_networks({kind: path})[kind]
    methods = {f"{kind}.{number}": network.show(1) for (kind, number), network in networks.items()}
    psnr: dict[tuple[Kind, int, str], FramePsnr] = {}
    for place, (dataset, split) in judges.items():
        found = frame_psnr(dataset, split, methods)
        psnr |= {(kind, number, place): found[f"{kind}.{number}"] for kind, number in names}
    return Curriculum(psnr, names)

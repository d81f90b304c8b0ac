"""tron-edit: a scene with edits done to it, as another file."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.scene_file import FoundMaterials, Up, check_scene_files
from tron.apps.splat_file import SceneFile
from tron.cli.command_line import ANEW, command
from tron.cli.installation import loading
from tron.cli.progress import track, working
from tron.errors import TronError
from tron.storage import write_atomic

if TYPE_CHECKING:
    from tron.editing import Edit, EditList, Views
    from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)

CAMERAS_FILES = ("cameras.json", "transforms.json")
SHOWN_OBJECTS = 20


class Settings(BaseModel):
    """Everything that tron-edit can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneFile = Field(
        description="the scene: a PLY of TRON, 3DGS or 2DGS, or another file of splats; it stays as it is"
    )
    edits: Path | Annotated[tuple[Path, ...], Field(min_length=1)] = Field(
        description="YAML with a list of edits, done in order; several files, [a.yaml,b.yaml], are merged "
        "if no object is named in two",
        examples=["[a.yaml,b.yaml]"],
    )
    output: Path = Field(description="PLY to write, or to replace; not the scene's own")
    cameras: Path | None = Field(
        None,
        description="JSON of the views that edits pick pixels or give masks in, as tron-relight takes it, or "
        "a folder with a cameras.json or transforms.json; null: cameras.json beside the scene",
    )
    materials: FoundMaterials = "auto"
    up: Up = None


def main(settings: Settings) -> None:
    """Remove, move, duplicate, insert or repaint parts of a scene, as a list of edits says.

    The YAML is a list; each edit has an action and says what it selects:

    [{action: remove, select: {object: 3}},

    {action: move, select: {box: {low: [0,0,0], high: [1,1,1]}}, by: [0,0,1], turn: 30, scale: 2},

    {action: duplicate, select: {sphere: {center: [0,0,1], radius: 0.5}}, by: [2,0,0], object: 9},

    {action: insert, file: cat.ply, at: [1,0,2], turn: 90},

    {action: material, select: {object: 2}, hue: 200, roughness: {scale: 0.5}, metallic: 1},

    {action: separate, select: {grow: {view: 0, at: [[120, 80]]}}, object: 8}]

    separate gives what it selects a number of its own, by which later edits, motion and tron-view name it.
    What else selects: material (ranges), grow (from a picked surfel or pixel), clicks (inside and outside),
    masks (of views). Several together hold at once; any joins selections, but_not takes one away.

    Writes the scene with the edits done, or nothing. What is known of the scene stays known: its up, its
    materials, which are found first as by tron-relight, and in another folder its cameras.json and
    environment.exr. The same is in Python: tron.editing.
    """
    with loading("tron-edit"):  # not for --help or a mistyped key
        from tron.editing import Insert, Material
        from tron.scans.scan import Scan

    if settings.output.suffix.lower() != ".ply":
        mend = "give it a name that ends with .ply; tron-export makes other files of that"
        raise TronError("output is no PLY", settings.output, mend)
    check_scene_files(settings.scene, settings.output, *_files(settings), _cameras_file(settings))
    edits, where = _read(settings)
    with working("reading the scene"):
        scan = Scan.open(
            settings.scene, up=settings.up, materials=settings.materials, apart=settings.output.parent,
            track=track, key="",
        )  # fmt: skip
    scene = scan.in_file
    _describe(scene)
    if scene.offset.any():
        log.info("coordinates of edits are about %s", scene.offset.tolist())
    if scene.materials_guessed and any(isinstance(each, Insert | Material) for each in edits):
        log.warning(
            "%s has no materials of its own: tron-relight would find them and undo these edits; give it "
            "materials=as_is too", settings.scene,
        )  # fmt: skip
    edited = edits.apply(scene, _views(settings, scene), where, _said)
    edited.save(settings.output)
    _keep_beside(settings.scene, settings.output)
    _describe(edited)
    log.info("%d surfels, now %d: %s", len(scene), len(edited), settings.output)


def _cameras_file(settings: Settings) -> Path | None:
    """The file of cameras that was asked for: of a folder, the one in it."""
    path = settings.cameras
    if path is None or not path.is_dir():
        return path
    for name in CAMERAS_FILES:
        if (path / name).is_file():
            return path / name
    mend = "give the cameras.json that tron-reconstruct writes beside its scene"
    raise TronError(f"the folder holds no {' and no '.join(CAMERAS_FILES)}", path, mend)


def _keep_beside(scene: Path, output: Path) -> None:
    """Let a scene's cameras and the light of its capture, where they lie beside it, lie beside the output."""
    from tron.scans.camera_files import CAMERAS
    from tron.scans.scan import LIGHT

    for name in (CAMERAS, LIGHT):
        own, there = (path.with_name(name) for path in (scene, output))
        known, found = (path.read_bytes() if path.is_file() else None for path in (own, there))
        if known == found:
            continue
        if known is not None and found is None:
            write_atomic(there, known)
            log.info("%s goes with it: %s", own, there)
        else:
            log.warning(
                "%s is not of this scene, and commands will take it for its own: give another folder", there
            )


def _files(settings: Settings) -> tuple[Path, ...]:
    return (settings.edits,) if isinstance(settings.edits, Path) else settings.edits


def _read(settings: Settings) -> tuple[EditList, str]:
    """All edits, and what messages call them."""
    from tron.editing import EditList

    first, *others = _files(settings)
    edits = EditList.read(first)
    for path in others:
        edits = edits.merged(EditList.read(path))
    return edits, " and ".join(map(str, _files(settings)))


def _views(settings: Settings, scene: GaussianScene) -> Views:
    from tron.editing import Views
    from tron.io.cameras.registry import cameras_of
    from tron.scans.camera_files import CAMERAS, in_frame_of

    path = _cameras_file(settings) or settings.scene.with_name(CAMERAS)
    if settings.cameras is None and not path.is_file():
        return Views()
    try:
        cameras = in_frame_of(scene.offset, cameras_of(path), path)
    except TronError as error:
        if settings.cameras is not None:
            raise
        log.warning("%s; edits name no view without it", error)
        return Views()
    return Views(cameras, _names(path, len(cameras)))


def _names(path: Path, count: int) -> list[str]:
    """Names of a file's cameras: those of cameras.json, or of the photos of a transforms.json."""
    content = json.loads(path.read_text("utf-8"))
    if isinstance(content, list):
        found = [each.get("img_name") for each in content]
    else:
        frames = content.get("frames")  # of relight.json their number
        frames = frames if isinstance(frames, list) else []
        found = content.get("names") or [each.get("file_path") for each in frames]
    whole = len(found) == count and all(isinstance(each, str) for each in found)
    return [str(each) for each in found] if whole else []


def _said(edits: Iterable[Edit]) -> Iterator[Edit]:
    edits = list(edits)
    for n, edit in enumerate(edits, 1):
        log.info("edit %d of %d: %s", n, len(edits), edit.action)
        yield edit


def _describe(scene: GaussianScene) -> None:
    """Say which objects there are, so that edits can name them."""
    import numpy as np

    ids, counts = np.unique(scene.object_id, return_counts=True)
    for number, count in list(zip(ids, counts))[:SHOWN_OBJECTS]:
        means = scene.means[scene.object_id == number]
        low, high = (", ".join(f"{value:.3g}" for value in corner) for corner in (means.min(0), means.max(0)))
        log.info("object %d: %d surfels from [%s] to [%s]", number, count, low, high)
    if len(ids) > SHOWN_OBJECTS:
        log.info("and %d objects more", len(ids) - SHOWN_OBJECTS)


cli = command(
    "tron-edit",
    "conf.edit",
    Settings,
    main,
    shown=("scene", "edits", "output", "cameras", "materials", "up"),
    examples=(
        "tron-edit scene=surfels.ply edits=edits.yaml output=edited.ply",
        "tron-edit scene=scan.ply edits=clicks.yaml cameras=capture/transforms.json output=cut.ply",
        "tron-edit scene=surfels.ply edits=[mine.yaml,yours.yaml] output=ours.ply",
    ),
    ended=ANEW,
)

if __name__ == "__main__":
    cli()

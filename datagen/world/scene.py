"""SceneSpec: everything a synthetic scene is, as pure data drawn from a seed.

A scene is named by its split and index; its specification depends on (root seed, split, index) and the recipe
of the split alone. What it is rendered with (resolution, samples) is the run's business and not part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from pydantic import Field

from datagen.world.lights import (
    EVERY,
    USUAL,
    Family,
    HdriSpec,
    LightChoice,
    LightSpec,
    draw_light,
)
from datagen.world.materials.photographed import dressed
from datagen.world.motion import STILL, MotionSpec, Share, draw_motion
from datagen.world.objects import ObjectSpec
from datagen.world.paths import PathSpec, WalkPath
from datagen.world.shapes import SHAPES
from datagen.world.spec import Number, Spec
from datagen.world.styles import MIXED, STYLES, Choice, Style, StyleChoice
from tron.cameras import Camera
from tron.errors import TronError
from tron.seeds import generator

SPEC_VERSION = 2
BOUNCES, INDOOR_BOUNCES = 4, 14
"""Times that light bounces between surfaces on its way to the one that is seen; 0 is direct light."""


class CameraSpec(Spec):
    """Paths of the cameras.

    Attributes:
        capture: what the views lie on that surfels are made from, an equal share on each.
        film: what is path-traced lies on it.
        path_frames: frames of the whole of ``film``.
        first_frame: where on it the clips begin: all lights' at one place, or each light's at its own.
    """

    capture: tuple[PathSpec, ...] = Field(min_length=1)
    film: PathSpec
    path_frames: int
    first_frame: int | tuple[int, ...]

    @property
    def shared(self) -> bool:
        """Whether all lights are filmed from the same places, frame by frame."""
        return isinstance(self.first_frame, int)


class SceneSpec(Spec):
    """One scene: objects in surroundings, lights, cameras.

    Attributes:
        surroundings: floor, walls, terrain; their object ids count from 1.
        objects: their ids go on from there.
        left_out: objects that found no place.
        metered: clips are exposed for what they show, not for the light.
        motion: the object that moves within a clip, if one does.
        turns_deg: by how much each light turns about the zenith within its clip; empty: none does.
    """

    version: int = SPEC_VERSION
    name: str
    split: str
    index: int
    seed: int
    style: Style
    surroundings: tuple[ObjectSpec, ...]
    objects: tuple[ObjectSpec, ...]
    left_out: int
    metered: bool = False
    motion: MotionSpec | None = None
    turns_deg: tuple[Number, ...] = ()
    lights: tuple[LightSpec, ...] = Field(min_length=1)
    cameras: CameraSpec

    @property
    def path_bounces(self) -> int:
        """Times that light bounces between surfaces in path-traced frames: more often between four walls.

        With 4 rooms get 0.986 to 0.999 of their light (three seeds), with 14 all but a thousandth of it, even
        under the whitest plaster; objects in the open get all of it with 4.
        """
        return INDOOR_BOUNCES if self.metered else BOUNCES

    def views(self, count: int, width: int, height: int) -> list[Camera]:
        """The ``count`` cameras that surfels are made from."""
        shares = np.diff(np.arange(len(self.cameras.capture) + 1) * count // len(self.cameras.capture))
        return [
            camera
            for path, share in zip(self.cameras.capture, shares.tolist())
            if share
            for camera in path.cameras(share, width, height)
        ]

    def groups(self) -> list[list[int]]:
        """Numbers of the lights whose clips are filmed together."""
        numbers = list(range(len(self.lights)))
        return [numbers] if self.cameras.shared else [[number] for number in numbers]

    def clip(self, light: int, frames: int, width: int, height: int) -> list[Camera]:
        """The consecutive cameras of the clip under light number ``light``."""
        first = self.cameras.first_frame
        first = first if isinstance(first, int) else first[light]
        return self.cameras.film.cameras(self.cameras.path_frames, width, height)[first : first + frames]


def scene_name(split: str, index: int) -> str:
    """A scene's name within a dataset, e.g. ``train-000012``."""
    return f"{split}-{index:06d}"


def draw_scene(
    seed: int,
    split: str,
    index: int,
    *,
    style: StyleChoice,
    lights: Sequence[LightChoice],
    families: Sequence[Family] | None = None,
    environments: Sequence[HdriSpec] = (),
    map_share: float = 1.0,
    choice: Choice | None = None,
    frames: int = 5,
    path_frames: int = 93,
    lights_share_path: bool = True,
    moving: Share = STILL,
    still_camera: bool = False,
) -> SceneSpec:
    """Draw scene ``index`` of a split.

    Args:
        seed: the run's root seed.
        split, index: which scene; they name its random streams.
        style: what stands there and how it is filmed; ``mixed`` draws one of MIXED.
        lights: for each light of the scene a family, ``any`` of ``families``, or a class of contrast.
        families: what ``any`` and classes choose from; None: USUAL, and EVERY.
        environments: files for the family ``hdri``.
        map_share: probability that a light which is not of a family by name is drawn from those, where
            ``families`` are these alone.
        choice: what the recipe says of objects; None leaves it to the style.
        frames, path_frames: length of a clip and of the path it is cut from.
        lights_share_path: whether the clips of all lights begin at one place.
        moving: probabilities that something moves within a clip.
        still_camera: all lights' clips are filmed from one place of the path.

    Raises:
        TronError: too few objects found a place, or a clip is longer than its path.
    """
    if frames > path_frames:
        raise TronError(
            f"a clip of {frames} frames does not fit a path of {path_frames}", mend="raise path_frames"
        )
    streams = partial(generator, seed, split, index)
    if style == "mixed":
        style = MIXED[int(streams("style").integers(len(MIXED)))]
    try:
        made = STYLES[style](streams, choice or Choice())
    except TronError as error:
        raise TronError(error.what, error.where or scene_name(split, index), error.mend) from error

    def drawn_from(k: int, wanted: LightChoice) -> Sequence[Family]:
        usual = USUAL if wanted == "any" else EVERY
        if not families or (list(families) == ["hdri"] and streams("map", k).random() >= map_share):
            return usual
        return families

    drawn = [
        draw_light(streams("light", k), wanted, drawn_from(k, wanted), environments)
        for k, wanted in enumerate(lights)
    ]
    dressing = partial(_dressed, choice=choice or Choice(), rng=streams("textures"))
    motion, turns = draw_motion(streams("motion"), made.objects, len(lights), moving)
    rng = streams("clips")
    first = [
        int(rng.integers(path_frames - frames + 1)) for _ in (lights[:1] if lights_share_path else lights)
    ]
    film = made.film
    if still_camera:
        film, first = _standing(made.film, first[0], path_frames), [0] * len(first)
    return SceneSpec(
        name=scene_name(split, index),
        split=split,
        index=index,
        seed=seed,
        style=style,
        surroundings=tuple(dressing(item) for item in made.surroundings),
        objects=tuple(dressing(item) for item in made.objects),
        left_out=made.left_out,
        metered=made.metered,
        motion=motion,
        turns_deg=turns,
        lights=tuple(drawn),
        cameras=CameraSpec(
            capture=made.capture,
            film=film,
            path_frames=path_frames,
            first_frame=first[0] if lights_share_path else tuple(first),
        ),
    )


def _standing(film: PathSpec, frame: int, path_frames: int) -> WalkPath:
    """A path that stays at one frame of another."""
    camera = film.cameras(path_frames, 2, 2)[frame]
    target = camera.position + camera.forward
    return WalkPath(
        fov_deg=film.fov_deg,
        positions=((*camera.position.tolist(),),),
        targets=((*target.tolist(),),),
    )


def _dressed(item: ObjectSpec, choice: Choice, rng: np.random.Generator) -> ObjectSpec:
    """The object with the user's texture sets on some of its pieces."""
    if item.shape is None or not choice.textures:
        return item
    roles = SHAPES[item.shape.kind].roles
    materials = tuple(
        dressed(material, roles[slot % len(roles)], choice.textures, choice.texture_share, rng)
        for slot, material in enumerate(item.materials)
    )
    return item.model_copy(update={"materials": materials})

"""tron-environment: a picture of light, measured, turned, shown and written as a lat-long map."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tron.apps.scene_file import check_output
from tron.cli.command_line import command
from tron.cli.progress import working
from tron.errors import TronError
from tron.io.lights import ENCODINGS, lat_long_of_ball, read_picture

if TYPE_CHECKING:
    from tron.shading.environments.environment import EnvironmentMap

log = logging.getLogger(__name__)

MAPS = (".exr", ".hdr")
BALL = 256
"""Pixels of a ball in the preview, under a map of twice as many rows."""


class Settings(BaseModel):
    """Everything that tron-environment can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    environment: Path = Field(
        description="the light: a lat-long picture, a cube map's cross or strip, a folder of six faces (px, "
        "nx, py, ny, pz, nz, or right, left, top, bottom, front, back), "
        f"{', '.join(each.holds for each in ENCODINGS)}, or a photo of a mirror ball"
    )
    output: Path | None = Field(None, description="lat-long .exr or .hdr to write, or to replace")
    picture: Path | None = Field(
        None, description="PNG to write, or to replace: the light, and a mirror and a white ball under it"
    )
    rotation: float = Field(
        0.0, description="rotation of the environment about up, degrees, counter-clockwise seen from above"
    )
    height: int | None = Field(
        None, ge=4, le=16384, description="rows of the map; none: as many as the file has, 512 for a ball"
    )
    layout: Literal["auto", "mirror_ball", "angular"] = Field(
        "auto", description="auto: told by the file; a square picture is a mirror ball or an angular map"
    )
    crop: tuple[float, float, float] | None = Field(
        None,
        description="column and row of the ball's centre and its radius, pixels; none: the picture's middle",
    )
    distance: float = Field(
        100.0, gt=1, description="distance of the camera from the mirror ball's centre, in radii of the ball"
    )

    @model_validator(mode="after")
    def _of_a_ball(self) -> Settings:
        if self.layout == "auto" and self.crop is not None:
            raise ValueError("crop is of layout=mirror_ball or angular")
        return self


def main(settings: Settings) -> None:
    """Read light in any form it is found in; measure, turn, show it, write it as a lat-long map.

    The log says contrast (the share of all light from the brightest hundredth of the sphere, and its class),
    mean radiance, the direction of the brightest light and the exposure that tron-relight gives networks.
    +z is up; the middle of the map is -y, its right quarter -x. A mirror ball's map has in the middle what
    lies behind the ball.
    """
    # Mitsuba: not for --help or a mistyped key
    from tron.io.images import write_image
    from tron.shading.environments.environment import EnvironmentMap

    for path, suffixes in ((settings.output, MAPS), (settings.picture, (".png",))):
        if path is not None:
            if path.suffix.lower() not in suffixes:
                raise TronError("unknown format", path, f"use one of {', '.join(suffixes)}")
            check_output(path, settings.environment, "the light")
    with working("reading the light"):
        if settings.layout == "auto":
            environment = EnvironmentMap.load(settings.environment, settings.rotation)
        else:
            picture, _ = read_picture(settings.environment)
            if picture.ndim != 3:
                raise TronError(f"a cube map is no {settings.layout}", settings.environment)
            ball = lat_long_of_ball(
                picture, settings.layout, settings.crop, settings.distance, settings.height or 512
            )
            environment = EnvironmentMap(ball, settings.rotation)
        if settings.height is not None:
            environment = environment.resized(settings.height)
    _log_measured(environment)
    with working("writing"):
        if settings.output is not None:
            environment.save(settings.output)
            log.info("%d x %d pixels: %s", *environment.image.shape[1::-1], settings.output)
        if settings.picture is not None:
            write_image(settings.picture, preview(environment))
            log.info("preview: %s", settings.picture)


def preview(environment: EnvironmentMap) -> np.ndarray:
    """Display values (3 BALL, 4 BALL, 3): the map, and under it a mirror and a white ball, seen along -y."""
    from tron.color import to_display

    light = environment.baked()
    exposure = light.exposure()
    at = (np.arange(BALL) + 0.5) / BALL * 2 - 1
    x, z = np.meshgrid(at, -at)
    inside = x**2 + z**2 < 1
    y = np.sqrt(np.maximum(1 - x**2 - z**2, 0))
    normal = np.stack([-x, y, z], axis=-1)  # the camera stands at +y, so +x is to its left
    mirrored = light.lookup(2 * normal[..., 1:2] * normal - [0.0, 1.0, 0.0])
    few = light.resized(min(16, light.image.shape[0]))
    towards = few.directions().reshape(-1, 3)
    power = few.image.reshape(-1, 3) * np.repeat(few.solid_angles(), few.image.shape[1])[:, None] / np.pi
    facing = np.maximum(normal.reshape(-1, 3).astype(np.float32) @ towards.T.astype(np.float32), 0)
    white = (facing @ power.astype(np.float32)).reshape(BALL, BALL, 3)
    shown = np.zeros((3 * BALL, 4 * BALL, 3), np.float32)
    shown[: 2 * BALL] = to_display(light.resized(2 * BALL).image, exposure)
    for place, ball in ((BALL // 2, mirrored), (5 * BALL // 2, white)):
        shown[2 * BALL :, place : place + BALL] = np.where(inside[..., None], to_display(ball, exposure), 0)
    return shown


def _log_measured(environment: EnvironmentMap) -> None:
    from tron.color import luminance
    from tron.shading.environments.contrast import classify, contrast_share

    small = environment.baked().resized(min(64, environment.image.shape[0]))
    energy = np.asarray(luminance(small.image)) * small.solid_angles()[:, None]
    x, y, z = small.directions().reshape(-1, 3)[int(energy.argmax())]
    log.info(
        "contrast %.3f (%s), mean radiance %s, exposure %.4g, brightest towards [%.2f, %.2f, %.2f]",
        contrast_share(environment), classify(environment),
        " ".join(f"{value:.4g}" for value in environment.mean()), environment.exposure(), x, y, z,
    )  # fmt: skip


cli = command(
    "tron-environment",
    "conf.environment",
    Settings,
    main,
    shown=("environment", "output", "picture", "rotation", "height", "layout", "crop", "distance"),
    examples=(
        "tron-environment environment=sky_cross.hdr output=sky.exr picture=sky.png",
        "tron-environment environment=cube.ktx2 output=studio.hdr rotation=90 height=1024",
        "tron-environment environment=ball.jpg layout=mirror_ball crop=[812,640,402] output=room.exr",
    ),
)

if __name__ == "__main__":
    cli()

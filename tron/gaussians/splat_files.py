"""Scenes as files of splats or points for other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile

from tron.errors import TronError
from tron.framing import Y_UP, upright
from tron.gaussians.edit import with_kernel
from tron.gaussians.fields import FIELDS
from tron.gaussians.formats.packed import changing
from tron.gaussians.formats.registry import BY_SUFFIX, WRITTEN
from tron.gaussians.harmonics import dc_to_rgb
from tron.gaussians.ply import NORMAL
from tron.gaussians.scene import GaussianScene
from tron.io.optional import usd
from tron.storage import atomic_path, write_atomic

MOST_SOG = 64_000
"""Splats with harmonics beyond degree 0 that gaussforge packs as .sog within a minute. From 65,000 on it
gathers them around 65,536 others, and 100,000 were not done after ten minutes."""
_SEEN = 0.1
"""Opacity from which a surfel is a point."""


def check_suffix(path: Path) -> None:
    """Raise TronError unless :func:`write_splats` knows a file's suffix, and what writes it is there."""
    suffix = path.suffix.lower()
    if suffix not in WRITTEN:
        known = ", ".join(WRITTEN)
        raise TronError("its name does not say a format", path, f"let it end with one of {known}")
    if suffix.startswith(".usd"):
        usd(str(path))


def check_count(path: Path, count: int) -> None:
    """Raise TronError if a file's format does not take so many splats whose colours change with the view."""
    if path.suffix.lower() == ".sog" and count > MOST_SOG:
        what = f"{count:,} splats with harmonics, and .sog is packed here up to {MOST_SOG:,}"
        raise TronError(what, path, "write .spz, or .ply and then: splat-transform scene.ply scene.sog")


def write_splats(path: Path, scene: GaussianScene) -> None:
    """Write a scene's radiance for other programs: the kernel and the properties of 3DGS, no materials.

    A kernel of degree 4 becomes one of degree 2 (:func:`tron.gaussians.edit.with_kernel`). Packed files
    round places, sizes and colours; ``.splat`` holds colours from all sides alone. glTF and USD are y up, the
    others stay in the scene's frame.

    Raises:
        TronError: no such suffix, no surfels, places or a number of them that the format does not hold, or
            the file cannot be written.
    """
    check_suffix(path)
    if not len(scene):
        raise TronError("there are no surfels to write", path)
    suffix = path.suffix.lower()
    known = BY_SUFFIX[suffix]
    assert known.write is not None
    if changing(scene.sh):
        check_count(path, len(scene))
    if known.y_up:
        scene = scene.rotated(Y_UP @ upright(scene.up))
    elif known.turn is not None:
        scene = scene.rotated(known.turn)
    plain = with_kernel(scene, 2)
    values = vars(plain) | {"normals": plain.normals(), "materials_guessed": True}
    write_atomic(path, known.write(values, suffix))


def write_points(path: Path, scene: GaussianScene) -> int:
    """Write the centres of surfels that are seen as a PLY of points; return their number.

    They have normals and mean colours, and stand where the file that the scene came from put them, in doubles
    where coordinates are large.

    Raises:
        TronError: the surfels can all be looked through, or the file cannot be written.
    """
    seen = scene.opacities() >= _SEEN
    if not seen.any():
        raise TronError("no surfel is opaque enough to be a point")
    places = (scene.means + scene.offset)[seen] if scene.offset.any() else scene.means[seen]
    colors = (np.clip(dc_to_rgb(scene.sh[seen, 0]), 0, 1) * 255).round().astype(np.uint8)
    columns = dict(zip(FIELDS["means"].properties, places.T))
    columns |= dict(zip(NORMAL, scene.normals()[seen].T)) | dict(zip(("red", "green", "blue"), colors.T))
    rows = np.empty(len(places), [(name, each.dtype.newbyteorder("<")) for name, each in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    with atomic_path(path) as temporary:
        plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))
    return len(rows)

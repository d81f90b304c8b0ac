"""Scenes as files of splats or points for other programs."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import plyfile

from tron.errors import TronError
from tron.framing import Y_UP, upright
from tron.gaussians.edit import with_kernel
from tron.gaussians.fields import FIELDS, third_scales
from tron.gaussians.formats.registry import FORMATS
from tron.gaussians.formats.splats import Splats
from tron.gaussians.harmonics import dc_to_rgb
from tron.gaussians.packed_files import HALF_TURN, PACKED_SPLATS, packed
from tron.gaussians.ply import NORMAL, write_ply
from tron.gaussians.scene import GaussianScene
from tron.gaussians.spz_precision import refined
from tron.io.optional import usd
from tron.storage import atomic_path, write_atomic

SUFFIXES = (".ply", *PACKED_SPLATS, *(suffix for suffix, each in FORMATS.items() if each.write))
"""Of files that :func:`write_splats` writes."""
MOST_SOG = 64_000
"""Splats with harmonics beyond degree 0 that gaussforge packs as .sog within a minute. From 65,000 on it
gathers them around 65,536 others, and 100,000 were not done after ten minutes."""
_CHANGING = 1e-4
"""Coefficient beyond degree 0 from which packed files hold harmonics; 8 bits of display are 4e-3."""
_SEEN = 0.1
"""Opacity from which a surfel is a point."""


def check_suffix(path: Path) -> None:
    """Raise TronError unless :func:`write_splats` knows a file's suffix, and what writes it is there."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = ", ".join(SUFFIXES)
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
    other = FORMATS.get(suffix)
    if other is not None and other.write is not None:
        write_atomic(path, other.write(_splats(scene.rotated(Y_UP @ upright(scene.up))), suffix))
        return
    kind = PACKED_SPLATS.get(suffix)
    if kind is None:
        _write_plain(path, scene)
        return
    changing = bool(np.abs(scene.sh[:, 1:]).max() > _CHANGING)
    if changing:
        check_count(path, len(scene))
    with tempfile.TemporaryDirectory(prefix="tron-") as folder:
        plain = Path(folder) / "plain.ply"
        turned = scene.rotated(HALF_TURN) if kind.half_turned else scene
        _write_plain(plain, turned, changing)
        content = packed(plain.read_bytes(), kind)
    write_atomic(path, refined(content, turned.means, turned.sh) if suffix == ".spz" else content)


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


def _splats(scene: GaussianScene) -> Splats:
    plain = with_kernel(scene, 2)
    third = third_scales(plain.log_scales, plain.log_thickness)
    log_scales = np.concatenate([plain.log_scales, third[:, None]], axis=1)
    return Splats(plain.means, plain.quats, log_scales, plain.opacity_logits, plain.sh)


def _write_plain(path: Path, scene: GaussianScene, changing: bool = True) -> None:
    plain = with_kernel(scene, 2)
    values = vars(plain) | {"normals": plain.normals(), "materials_guessed": True}
    write_ply(path, values, plain=True, changing=changing)

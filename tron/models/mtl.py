"""Wavefront material libraries (.mtl): the statements that a surface of ours can have, and their options.

Written after the format's description (Alias|Wavefront, MTL material format, 1995) and the PBR extension of
Clara.io that exporters follow. trimesh reads one library, no option and no PBR statement; tinyobjloader has
release candidates alone, and takes neither backslashes nor continued lines.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tron.errors import TronError
from tron.io.gltf_document import confined

LARGEST = 2**20
"""Bytes of a library."""

_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-colorspace": 1, "-imfchan": 1,
    "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-type": 1,
}  # fmt: skip
"""Arguments of each option; of those with three the last two may be missing."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
_KEYS = {"map_bump": "bump", "map_norm": "norm", "norm": "norm", "map_tr": "map_tr"}
_TEXTURES = ("map_kd", "map_d", "map_pr", "map_pm", "norm", "bump")
_LEFT_OUT = ("ps", "map_ps", "pc", "pcr", "aniso", "anisor", "map_tr")
_UNUSED_OPTIONS = {"-boost": "0", "-texres": "", "-t": "0", "-blendu": "on", "-blendv": "on", "-cc": "off"}
"""Options that nothing here follows, and the value that asks for nothing."""


@dataclass(frozen=True)
class Texture:
    """A texture statement.

    Attributes:
        name: file as the library names it, with forward slashes.
        library: that library.
        scale, offset: of (u, v): looked up at ``scale * uv + offset``, v upwards.
        clamp: the edge goes on outside the image, which otherwise repeats.
        channel: of ``-imfchan``: r, g, b, m (alpha), l (luminance), z; empty where nothing is said.
        base, gain: of ``-mm``: value = base + gain * stored.
        bump: of ``-bm``, factor of the relief.
    """

    name: str
    library: Path
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False
    channel: str = ""
    base: float = 0.0
    gain: float = 1.0
    bump: float = 1.0

    def file(self, model: Path) -> Path:
        """Path beside the library, else beside the model; TronError unless in the model's folder."""
        home = self.library.parent.relative_to(model.parent.resolve()).as_posix()
        for name in (f"{home}/{self.name}", self.name):
            try:
                return confined(model, name if not self.name.startswith("/") else self.name)
            except TronError:
                continue
        raise TronError(f"texture '{self.name[:80]}' cannot be read, or lies outside the model's folder")


@dataclass
class MtlMaterial:
    """Statements of one material.

    Attributes:
        diffuse: Kd, display values; None where it is not said.
        opacity: d, or 1 - Tr.
        roughness, metallic: Pr, Pm; None where they are not said.
        textures: by statement: map_kd, map_d, map_pr, map_pm, norm, bump.
        left_out: statements and options that are not honoured.
    """

    diffuse: tuple[float, float, float] | None = None
    opacity: float = 1.0
    roughness: float | None = None
    metallic: float | None = None
    textures: dict[str, Texture] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def joined_lines(text: str) -> str:
    """The text without line continuations, lines ended by line feeds."""
    return re.sub(r"\\[ \t]*\n", " ", text.replace("\r\n", "\n").replace("\r", "\n"))


def library_names(obj: str) -> list[str]:
    """Names in the ``mtllib`` statements of an OBJ's text (lines joined), a statement each."""
    return [line.strip() for line in re.findall(r"^[ \t]*mtllib[ \t]+(.+)$", obj, re.MULTILINE)]


def find_libraries(model: Path, obj: str) -> tuple[list[Path], list[str]]:
    """Libraries of an OBJ in order, and the names of those that are missing.

    A statement is one file whose name has spaces, where there is such a file, and several names elsewhere.

    Raises:
        TronError: none of them can be read, or one is too large.
    """
    found: list[Path] = []
    missing: dict[str, TronError] = {}
    for statement in library_names(obj):
        for names in ([statement], statement.split()):
            tried = [(name, _library(model, name)) for name in names]
            if any(isinstance(path, Path) for _, path in tried):
                break
        else:
            tried = [(name, _library(model, name)) for name in statement.split()]
        for name, path in tried:
            if isinstance(path, Path):
                found.append(path)
            else:
                missing[name] = path
    if missing and not found:
        raise next(iter(missing.values()))
    for path in found:
        if path.stat().st_size > LARGEST:
            raise TronError(f"material library of {path.stat().st_size >> 20} MiB is too large")
    return list(dict.fromkeys(found)), list(missing)


def _library(model: Path, name: str) -> Path | TronError:
    try:
        return confined(model, _slashed(name))
    except TronError as error:
        return error


def _slashed(name: str) -> str:
    return re.sub(r"[\\/]+", "/", name.strip().strip('"')).removeprefix("./")


def read_library(path: Path) -> dict[str, MtlMaterial]:
    """Materials of a library by name; the first of each name counts.

    Raises:
        TronError: a statement has no numbers where it needs some.
    """
    materials: dict[str, MtlMaterial] = {}
    material, seen = MtlMaterial(), set[str]()
    for key, value in _statements(path.read_text("utf-8", "replace")):
        if key == "newmtl":
            material, seen = MtlMaterial(), set[str]()
            materials.setdefault(value, material)
        elif key == "kd":
            if value.split()[:1] in (["spectral"], ["xyz"]):
                material.left_out.append(f"Kd {value.split()[0]}")
            else:
                color = _numbers(value, key)
                red, green, blue = color if len(color) == 3 else (color[0],) * 3
                material.diffuse = (red, green, blue)
        elif key == "d" or (key == "tr" and "d" not in seen):
            number = _numbers(value.replace("-halo", ""), key)[0]
            material.opacity = number if key == "d" else 1 - number
        elif key == "pr":
            material.roughness = _numbers(value, key)[0]
        elif key == "pm":
            material.metallic = _numbers(value, key)[0]
        elif key in _TEXTURES and value:  # exporters write the statement without a name
            material.textures[key] = _texture(value, path, material.left_out)
        elif key in _LEFT_OUT and value not in ("0", "0.0", "0.000000"):
            material.left_out.append(key.capitalize() if key.startswith("p") else key)
        seen.add(key)
    return materials


def _statements(text: str) -> Iterator[tuple[str, str]]:
    """Keywords in lower case, and what follows them."""
    for line in joined_lines(text.removeprefix("\ufeff")).split("\n"):
        key, _, value = line.strip().replace("\t", " ").partition(" ")
        if key and not key.startswith("#"):
            yield _KEYS.get(key.lower(), key.lower()), value.strip()


def _numbers(value: str, key: str) -> list[float]:
    try:
        numbers = [float(number) for number in value.split("#")[0].split()[:3]]
    except ValueError:
        numbers = []
    if not numbers or not all(abs(number) < 1e6 for number in numbers):
        raise TronError(f"material library has '{key} {value[:40]}', which needs numbers")
    return numbers


def _texture(value: str, library: Path, left_out: list[str]) -> Texture:
    """A texture statement's options and file."""
    rest, given = value, dict[str, list[str]]()
    while (option := rest.split(" ", 1)[0]) in _OPTIONS and " " in rest:
        rest = rest.split(" ", 1)[1].strip()
        arguments: list[str] = []
        for number in range(_OPTIONS[option]):
            word = rest.split(" ", 1)[0]
            if number and not _NUMBER.match(word):
                break
            arguments.append(word)
            rest = rest[len(word) :].strip()
        given[option] = arguments
    for option, arguments in given.items():
        idle = _UNUSED_OPTIONS.get(option)
        if idle is not None and any(
            word.lower() != idle and _value(word) != _value(idle) for word in arguments
        ):
            left_out.append(option)

    def numbers(option: str, count: int, default: float) -> list[float]:
        read = [_value(word) for word in given.get(option, [])][:count]
        if any(number is None for number in read):
            raise TronError(f"texture option {option} needs numbers", library)
        return [number for number in read if number is not None] + [default] * (count - len(read))

    (su, sv), (ou, ov) = numbers("-s", 2, 1.0), numbers("-o", 2, 0.0)
    base, gain = numbers("-mm", 2, 0.0) if "-mm" in given else (0.0, 1.0)
    return Texture(
        _slashed(rest), library, (su, sv), (ou, ov), given.get("-clamp", [""])[0].lower() == "on",
        given.get("-imfchan", [""])[0].lower(), base, gain, numbers("-bm", 1, 1.0)[0],
    )  # fmt: skip


def _value(word: str) -> float | None:
    return float(word) if _NUMBER.match(word) else None

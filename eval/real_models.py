"""A folder of real models and maps, ``assets`` and ``hdri``, as arguments of tron-datagen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

MODEL_FILES = (".gltf", ".glb", ".obj")
MAP_FILES = (".hdr", ".exr")


def has_models(data: Path) -> bool:
    """Whether the folder has both parts."""
    return all((data / name).is_dir() for name in ("assets", "hdri"))


def model_names(data: Path) -> list[str]:
    """Names of its models, sorted."""
    return _stems(data / "assets", MODEL_FILES)


def model_arguments(data: Path) -> list[str]:
    """Arguments that give a run the models and maps, licensed or not: what is judged is not handed on."""
    data = data.absolute()
    names = [*model_names(data), *_stems(data / "hdri", MAP_FILES)]
    return [
        f"assets={data / 'assets'}",
        f"environments={data / 'hdri'}",
        f"allow_unlicensed=[{','.join(names)}]",
    ]


def _stems(folder: Path, suffixes: Sequence[str]) -> list[str]:
    """Names of a folder's files as tron-datagen finds them: with its subfolders, suffixes in any case."""
    return sorted(path.stem for path in folder.rglob("*") if path.suffix.lower() in suffixes)

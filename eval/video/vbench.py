"""VBench's five prompt-free scores by the original package, in a Python of its own.

VBench (Huang et al. 2024, `vbench` on PyPI) wants other versions of NumPy and transformers than TRON, so it
runs out of process, in the Python that ``benchmark.vbench`` names. It downloads weights that are not there;
dimensions whose weights are missing are therefore left out and named, and nothing is downloaded.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tron.errors import TronError
from tron.io.video import VideoWriter

WEIGHTS: Mapping[str, Sequence[str]] = {
    "motion_smoothness": ["amt_model/amt-s.pth"],
    "subject_consistency": [
        "dino_model/dino_vitbase16_pretrain.pth",
        "dino_model/facebookresearch_dino_main/hubconf.py",
    ],
    "background_consistency": ["clip_model/ViT-B-32.pt"],
    "aesthetic_quality": ["clip_model/ViT-L-14.pt", "aesthetic_model/emb_reader/sa_0_4_vit_l_14_linear.pth"],
    "imaging_quality": ["pyiqa_model/musiq_spaq_ckpt-358bb6af.pth"],
}
"""Dimension -> files below VBENCH_CACHE_DIR that vbench 0.1.5 loads in local mode; the paper's five."""
PERCENT = ("imaging_quality",)
"""Dimensions whose figures of single videos are percent."""
SCRIPT = """
import sys, torch
from vbench import VBench
folder, *dimensions = sys.argv[1:]
device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
VBench(device, "", folder).evaluate(
    videos_path=folder, name="clips", dimension_list=dimensions, local=True, mode="custom_input"
)
"""
SIZE = (1920, 1080)
"""The paper's, width and height."""
FRAMES, FPS = 100, 24.0
"""The paper takes the first 100 frames."""


@dataclass(frozen=True)
class VBench:
    """Paths and time limit of VBench.

    Attributes:
        python: interpreter of an environment with ``vbench``.
        weights: VBENCH_CACHE_DIR.
        timeout: time limit of all dimensions, seconds.
    """

    python: Path
    weights: Path
    timeout: float

    def absent(self) -> dict[str, str]:
        """Return dimension -> reason why it cannot be measured."""
        if why := self._no_package():
            return dict.fromkeys(WEIGHTS, why)
        missing = {
            dimension: next((file for file in files if not (self.weights / file).is_file()), None)
            for dimension, files in WEIGHTS.items()
        }
        return {each: f"{self.weights / file} is missing" for each, file in missing.items() if file}

    def _no_package(self) -> str:
        command = [str(self.python), "-c", "import vbench"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=self.timeout, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{self.python} does not start: {error}"
        return "" if done.returncode == 0 else f"{self.python} has no vbench: {_last_line(done.stderr)}"

    def measure(self, folder: Path, dimensions: Sequence[str]) -> dict[str, dict[str, float]]:
        """Score all .mp4 of a folder; return dimension -> name of a clip -> score in [0, 1].

        Raises:
            TronError: it failed, took too long, or left out a clip.
        """
        command = [str(self.python), "-c", SCRIPT, str(folder.absolute()), *dimensions]
        environment = {**os.environ, "VBENCH_CACHE_DIR": str(self.weights.absolute())}
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=self.timeout,
                env=environment,
                cwd=folder,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            mend = "set benchmark.vbench_timeout"
            raise TronError(f"VBench took more than {self.timeout:g} s", self.python, mend) from error
        if done.returncode:
            raise TronError(f"VBench failed: {_last_line(done.stderr)}", self.python)
        return _read(folder / "clips_eval_results.json", dimensions, sorted(folder.glob("*.mp4")))


def write_clip(path: Path, frames: Sequence[np.ndarray] | np.ndarray) -> None:
    """Write the first FRAMES pictures (H, W, 3) of a clip as a film of the paper's size, bicubic."""
    with VideoWriter(path, FPS, SIZE) as film:
        for frame in frames[:FRAMES]:
            enlarged = cv2.resize(np.asarray(frame, np.float32), SIZE, interpolation=cv2.INTER_CUBIC)
            film.write(np.clip(enlarged, 0, 1))


def _read(path: Path, dimensions: Sequence[str], clips: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Read VBench's ``{dimension: [mean, [{"video_path", "video_results"}]]}``."""
    try:
        content = json.loads(path.read_bytes())
        found = {
            dimension: {
                Path(each["video_path"]).stem: float(each["video_results"])
                / (100 if dimension in PERCENT else 1)
                for each in content[dimension][1]
            }
            for dimension in dimensions
        }
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise TronError("VBench left no results that can be read", path) from error
    names = {clip.stem for clip in clips}
    for dimension, scores in found.items():
        if lacking := names - set(scores):
            raise TronError(f"VBench gave no {dimension} for clip {min(lacking)}", path)
        if not np.isfinite(list(scores.values())).all():
            raise TronError(f"VBench gave a {dimension} that is no number", path)
    return found


def _last_line(text: str) -> str:
    return next((line for line in reversed(text.splitlines()) if line.strip()), "it said nothing")[:200]

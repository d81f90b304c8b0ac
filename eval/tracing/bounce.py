"""Light that bounces: what it costs beside a frame, and how long path tracing takes to be as near the truth.

Transport is traced once a scene, a light is baked once, and a frame composites what was baked; each is timed
beside a frame of 64 shadow rays a pixel without it. The comparison with the path tracer needs true scenes,
which the data engine makes and judges (``tron-datagen mode=equal_error``).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.peers.timing import Rounds, interleaved
from eval.stages import Child, Stages
from eval.tracing.lights import LIGHTS
from eval.tracing.measured import BounceTimes, EqualError
from tron.errors import TronError
from tron.estimation import FINAL
from tron.shading import Lighting, render_guidance
from tron.shading.bounce import BounceTransport
from tron.shading.guidance import Guidance

LIGHT = "soft"
DATASET = "models"


def measure_bounce(contenders: Contenders, size: int, rounds: Rounds) -> BounceTimes:
    """Time transport, bake, and a frame with and without what was baked, in turns."""
    view, tracer, lighting = camera(size), contenders.tracer, Lighting(LIGHTS[LIGHT]())
    transport = BounceTransport.trace(tracer)
    baked = transport.bake(lighting)

    def frame(bounce: Any) -> Guidance:
        return render_guidance(tracer, view, lighting, FINAL, bounce=bounce)

    contestants = {
        "transport": lambda: BounceTransport.trace(tracer).rays.met,
        "bake": lambda: transport.bake(lighting),
        "frame": lambda: frame(None),
        "lit frame": lambda: frame(baked),
    }
    return BounceTimes(len(contenders.scene), size, interleaved(contestants, rounds))


def measure_equal_error(recipe: Sequence[str], folder: Path) -> EqualError:
    """Let the data engine make scenes and judge our frames of them against the path tracer.

    Args:
        recipe: arguments of tron-datagen.
        folder: of the benchmark; scenes that are there are not made again.

    Raises:
        StageFailed: tron-datagen failed.
        TronError: it wrote no such record.
    """
    dataset, stages = folder.absolute() / DATASET, Stages(folder.absolute())
    arguments = [*recipe, f"output_dir={dataset}"]
    stages.run("models", [Child("models", "tron-datagen", arguments)])
    stages.restart("equal_error")
    stages.run("equal_error", [Child("equal_error", "tron-datagen", [*arguments, "mode=equal_error"])])
    path = dataset / "equal_error.json"
    try:
        cases = json.loads(path.read_text("utf-8"))["cases"]
    except (OSError, ValueError, KeyError) as error:
        raise TronError(f"not a record of equal errors: {error}", path) from error
    return EqualError(cases, sorted((dataset / "equal_error").glob("*.png")))

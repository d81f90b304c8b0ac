"""The judge's prompt, from the TRON paper's "A/B Photorealism Additional Details", and its reply."""

from __future__ import annotations

import re
from typing import Literal

Answer = Literal["A", "B", "TIE"]

PROMPT = """\
Role: You are evaluating two images, A and B, which are different rendering methods of the same 3D scene \
under the same lighting environment. Your task is to decide which looks more photorealistic.

Setup: Both images depict the same camera viewpoint and illumination (same HDR environment map). They differ \
only in the rendering method. Absolute image size is not a discriminator. Judge purely on rendering quality, \
not on content, framing, or composition.

Criteria (in priority order):
1. Light transport: Are specular highlights and reflections placed where geometry and lighting predict? Does \
indirect light look plausible?
2. Shadow consistency: Are shadow positions, softness, and falloff coherent with light sources? Are contact \
shadows present?
3. Material plausibility: Do surfaces read as the correct material? Avoid plastic-looking metals, chalky \
albedos, or oversaturated highlights.
4. Geometric coherence: Are silhouettes clean? No popping, ghosting, or isolated artifacts \
indicating instability.
5. Color & exposure: Are tints coherent? Does brightness fall off naturally? Is the white balance plausible?
6. No neural artifacts: Penalize blocky/checkerboard textures, hallucinated detail, smeared edges, or any \
"AI-look" that breaks physical plausibility.
7. Daylight plausibility: Daytime scenes must not look uniformly dark. Globally dim renders where shadows \
should be present are penalized as failed rendering. Conversely, washed-out daylight lacking strong shadows \
where expected is also penalized.

What to ignore: Camera-level effects (lens distortion, vignette) and aesthetic preference. The goal is \
realism, not beauty.

Anti-bias instruction: Position (A or B) must not influence your decision. Imagine labels swapped, would \
your answer change?

Output: A single token. Use "A" or "B". Use "TIE" only when no meaningful difference exists.
"""

_THOUGHT = re.compile(r"<think>.*?</think>", re.DOTALL)
_TOKEN = re.compile(r"\W*(A|B|TIE)\W*", re.IGNORECASE)


def read_answer(text: str) -> Answer | None:
    """Return the single token of a reply, None for anything else; preceding thoughts are skipped."""
    found = _TOKEN.fullmatch(_THOUGHT.sub("", text))
    return None if found is None else found[1].upper()  # type: ignore[return-value]

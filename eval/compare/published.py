"""Material decomposition figures of the TRON paper; pages label them as the paper's.

Source: its table "Quantitative Material Decompositions Comparison". Base color is scaled for each view and
channel by least squares. Its TRON-Synth has other models and lights than ours, 800 x 800 pixels.
"""

from __future__ import annotations

from tron.report.page import Table

HEADINGS = ("Method", "albedo PSNR ↑", "SSIM ↑", "LPIPS ↓", "normals, mean error ↓")
Figures = tuple[float | None, float | None, float | None, float | None]
PAPER: dict[str, tuple[Figures, Figures, Figures]] = {
    "GS-IR": (
        (30.06, 0.928, 0.107, 5.32),
        (19.85, 0.831, 0.305, 10.85),
        (19.82, 0.841, 0.316, 11.69),
    ),
    "GI-GS": (
        (29.64, 0.927, 0.107, 5.25),
        (19.10, 0.797, 0.316, 10.17),
        (18.84, 0.814, 0.338, 11.22),
    ),
    "GaussianShader": (
        (23.55, 0.832, 0.168, 14.90),
        (9.23, 0.356, 0.533, 34.15),
        (8.54, 0.376, 0.540, 37.37),
    ),
    "GS-ID, as its own paper has it": (
        (33.49, 0.952, 0.079, 4.602),
        (None, None, None, None),
        (None, None, None, None),
    ),
    "DiffusionRenderer (Cosmos), a prior on pictures": (
        (33.22, 0.959, 0.073, 5.34),
        (30.99, 0.940, 0.156, 7.19),
        (31.11, 0.940, 0.131, 5.59),
    ),
    "UniRelight": (
        (32.69, 0.947, 0.089, None),
        (27.36, 0.854, 0.301, None),
        (27.98, 0.858, 0.273, None),
    ),
    "TRON": (
        (34.10, 0.964, 0.069, 4.37),
        (29.65, 0.933, 0.250, 4.97),
        (31.09, 0.925, 0.261, 3.58),
    ),
}
"""Method -> its figures on TensoIR, TRON-Synth Objects, TRON-Synth Scenes."""
_PLACES = {"tensoir": ((0, "TensoIR"),), "tron_synth": ((1, "TRON-Synth Objects"), (2, "TRON-Synth Scenes"))}
_SHOWN = ("{:.2f} dB", "{:.3f}", "{:.3f}", "{:.2f}°")


def published(suite: str) -> list[Table]:
    """Return the paper's tables for a suite, by the suite's name or id; none for other suites."""
    places = next((found for name, found in _PLACES.items() if suite.startswith(name)), ())
    return [
        Table(
            f"{title}, the paper's figures on its own data; nothing here measured them.",
            HEADINGS,
            [
                [method, *("" if x is None else form.format(x) for form, x in zip(_SHOWN, figures[place]))]
                for method, figures in PAPER.items()
                if any(x is not None for x in figures[place])
            ],
        )
        for place, title in places
    ]

"""Evaluate the renderer on scenes that it has not seen, beside baselines that need no network.

Writes results.json and report.html, and a bar for each method's PSNR.
"""

import json

import matplotlib.pyplot as plt

from eval.cli import cli, main
from examples.stage import OUTPUTS, arguments

chosen = arguments(
    __doc__,
    "evaluation",
    dataset=OUTPUTS / "dataset",
    renderer=OUTPUTS / "renderer" / "renderer.safetensors",
)
main(
    cli.compose(
        "benchmark=relighting",
        f"dataset={chosen.dataset}",
        f"renderer={chosen.renderer}",
        f"output_dir={chosen.output}",
    )
)
rows = json.loads((chosen.output / "results.json").read_text())["rows"]
psnr = {row["metric"].removesuffix(".psnr"): row["value"] for row in rows if row["metric"].endswith(".psnr")}
figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
bars = axes.barh(
    list(psnr), list(psnr.values()), color=["#c44" if name == "neural_lit" else "#89a" for name in psnr]
)
axes.bar_label(bars, fmt="%.1f", padding=3)
axes.margins(x=0.1)
axes.invert_yaxis()
axes.set_xlabel("PSNR of the surfels on unseen scenes, dB")
figure.savefig(chosen.output / "evaluation.jpg", dpi=100)
print(f"neural {psnr['neural_lit']:.1f} dB, lit {psnr['lit']:.1f} dB: {chosen.output / 'report.html'}")

"""tron-train: read a dataset folder, write output_dir/renderer.safetensors."""

from __future__ import annotations

from train.settings import Settings
from tron.cli.command_line import command
from tron.cli.installation import loading


def main(settings: Settings) -> None:
    """Train a neural renderer on a dataset through the stages of a curriculum.

    Ends with output_dir/renderer.safetensors. An interrupted run resumes from its last checkpoint when the
    same command is given again; a finished one is left as it is.
    """
    with loading("tron-train"):
        from train.run import run  # not for --help or a mistyped key

    run(settings)


cli = command(
    "tron-train",
    "conf.train",
    Settings,
    main,
    shown=(
        *("dataset", "output_dir", "max_seconds", "stages", "splits", "data.cache_gb"),
        *("optimizer.learning_rate", "precision", "devices", "start_from"),
    ),
    examples=(
        "tron-train experiment=demo dataset=outputs/demo/dataset output_dir=outputs/demo/renderer",
        "tron-train renderer=pixel_mlp max_seconds=300 dataset=DIR output_dir=outputs/pixel_mlp",
        "tron-train renderer.config.fusion=average dataset=DIR output_dir=outputs/average",
    ),
)

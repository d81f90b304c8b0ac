"""The command tron-reconstruct, which waits for nothing that does the work."""

from __future__ import annotations

from tron.apps.reconstruct.settings import Settings
from tron.cli.command_line import command
from tron.cli.installation import loading


def main(settings: Settings) -> None:
    """Turn posed photos, bare photos, path-traced views or splats into surfels with materials and a light.

    Writes scene.ply, which tron-relight and every 3DGS viewer open, environment.exr, metrics.json (held-out
    and training views), report.html (the scene relit, its G-buffers, its light, how sure each figure is),
    contact_sheet.png (held-out views and every channel), light.png, cameras.json (where the photos
    were taken, for tron-relight) and config.yaml. A run that was interrupted resumes when it is started
    again.
    """
    with loading("tron-reconstruct"):
        from tron.apps.reconstruct.command import run  # not for --help or a mistyped key

    run(settings)


cli = command(
    "tron-reconstruct",
    "conf.reconstruct",
    Settings,
    main,
    shown=(
        *("capture", "output_dir", "max_side", "downscale", "test_every", "masks"),
        *("steps_scaler", "splats.geometry", "lpips_weights", "overwrite"),
    ),
    examples=(
        "tron-reconstruct capture=photos output_dir=outputs/mine",
        "tron-reconstruct experiment=photos capture=fox output_dir=outputs/fox",
        "tron-reconstruct capture=scene prior=ground_truth initial.source=depth output_dir=out",
        "tron-reconstruct capture=scan.ply output_dir=outputs/relightable",
        "tron-reconstruct capture=garden prior=precomputed prior.folder=maps experiment=paper output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()

"""The command tron-relight, which waits for nothing that does the work."""

from __future__ import annotations

from tron.apps.relight.settings import Settings
from tron.cli.command_line import command
from tron.cli.installation import loading


def main(settings: Settings) -> None:
    """Light a Gaussian scene with environment maps and film it along a camera path.

    Writes frames/NNNN.relit.png, relit.mp4 (the neural renderer's pictures where there is a checkpoint,
    otherwise shadows, reflections and the light that bounces between the surfels), what they are made of as
    frames/NNNN.{pbr,irradiance,...}.exr (linear) and .png (AgX), guidance.mp4, contact_sheet.png and
    relight.json; with a checkpoint also NNNN.neural.png and neural.mp4. An interrupted run resumes when it is
    started again.
    """
    with loading("tron-relight"):
        from tron.apps.relight.command import run  # not for --help or a mistyped key

    run(settings)


cli = command(
    "tron-relight",
    "conf.relight",
    Settings,
    main,
    shown=(
        *("scene", "environment", "output_dir", "quality", "trajectory", "frames", "width"),
        *("rotation", "background", "checkpoint"),
    ),
    examples=(
        "tron-relight scene=surfels.ply environment=studio.hdr output_dir=outputs/relit",
        "tron-relight scene=surfels.ply environment=studio.hdr quality=final reflections=16 output_dir=out",
        "tron-relight scene=scan.ply environment=[dawn.hdr,night.hdr] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr trajectory=still rotation=[0,360] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr 'meshes=[{file: cow.glb, at: [0,0,1]}]' "
        "output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr background=transparent output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=renderer.safetensors output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=paper overlap=newest "
        "'weights={pbr: 0.3, irradiance: 0.7}' output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()

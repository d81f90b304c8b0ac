"""The command ``tron-datagen``."""

from __future__ import annotations

from datagen.settings.command import Settings
from tron.cli.command_line import command
from tron.cli.installation import loading


def main(settings: Settings) -> int:
    """Make a dataset for the neural renderer, plan or validate one, or make captures to reconstruct.

    Scenes are drawn from seeds, path-traced by Mitsuba, turned into surfels and rendered again by TRON's
    tracer; the pairs land in tar shards with a manifest. With mode=plan nothing is made:
    what is missing is printed with its bytes, memory and hours. With shard=i/n one part of a
    dataset is made; mode=merge joins them; mode=publish makes a folder for the Hub of a dataset.
    With mode=captures scenes are path-traced from all sides instead,
    with true maps, as folders that tron-reconstruct and nerfstudio read; with
    mode=pseudo_captures they are photographed as by a phone, and the truth is kept apart. With
    source=captured each folder of photos in captures=DIR is reconstructed and lit, and its photos are the
    pairs' truth. With mode=equal_error guidance of a dataset's test scenes is held against the path tracer:
    equal_error.json. An interrupted run resumes. The exit code is 1 if a scene could not be made
    (failures.jsonl says why, that of captures lies among them) or if validation found a problem.
    """
    with loading("tron-datagen"):  # not for --help or a mistyped key
        from datagen.equal_error import measure_equal_error
        from datagen.run.captures import CAMERAS, make_captures
        from datagen.run.cost import project
        from datagen.run.dataset import make
        from datagen.run.merge import merge
        from datagen.run.publish import publish
        from datagen.run.validate import validate

    if settings.mode == "validate":
        return 1 if validate(settings.output_dir, settings.disjoint_from, settings.store) else 0
    if settings.mode == "plan":
        print(project(settings))
        return 0
    if settings.mode == "merge":
        return 1 if merge(settings) else 0
    if settings.mode == "publish":
        publish(settings)
        return 0
    if settings.mode in CAMERAS:
        return 1 if make_captures(settings) else 0
    if settings.mode == "equal_error":
        measure_equal_error(settings)
        return 0
    return 1 if make(settings) else 0


cli = command(
    "tron-datagen",
    "conf.datagen",
    Settings,
    main,
    shown=(
        *("output_dir", "mode", "workers", "train.scenes", "test.scenes", "train.frames"),
        *("train.width", "train.path_spp", "assets", "environments"),
    ),
    examples=(
        "tron-datagen experiment=demo output_dir=outputs/dataset",
        "tron-datagen experiment=demo output_dir=outputs/mine assets=models environments=hdris workers=8",
        "tron-datagen experiment=paper output_dir=outputs/paper workers=64 mode=plan",
        "tron-datagen output_dir=outputs/dataset mode=validate",
        "tron-datagen experiment=demo output_dir=outputs/part1 shard=1/3",
        "tron-datagen experiment=demo output_dir=outputs/dataset mode=merge 'merge=[outputs/part1,...]'",
        "tron-datagen output_dir=outputs/dataset mode=publish publish=outputs/hub licence=cc-by-4.0",
        "tron-datagen experiment=captures output_dir=outputs/synthetic",
        "tron-datagen experiment=captured captures=photos output_dir=outputs/pairs",
        "tron-datagen experiment=pseudo_captures output_dir=outputs/pseudo",
    ),
)

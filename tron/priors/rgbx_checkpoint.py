"""The files of an RGB->X checkpoint, looked at without loading torch."""

from __future__ import annotations

from pathlib import Path

from tron.errors import TronError

MEND = "give a local copy of huggingface.co/zheng95z/rgb-to-x as checkpoint; nothing is downloaded"
CONFIGS = {
    "unet": "config.json",
    "vae": "config.json",
    "text_encoder": "config.json",
    "tokenizer": "tokenizer_config.json",
    "scheduler": "scheduler_config.json",
}
WEIGHTED = ("unet", "vae", "text_encoder")


def check_checkpoint(checkpoint: str | Path | None) -> Path:
    """The checkpoint's folder, if all its parts are there.

    Raises:
        TronError: no folder, or the first part that is missing or has no safetensors.
    """
    if not checkpoint:
        raise TronError("the prior rgbx has no checkpoint", mend=MEND)
    folder = Path(checkpoint)
    if not folder.is_dir():
        raise TronError("checkpoint of RGB->X not found", folder, MEND)
    for part, config in CONFIGS.items():
        if not (folder / part / config).is_file():
            raise TronError(f"the RGB->X checkpoint lacks {part}/{config}", folder, MEND)
        if part in WEIGHTED and not any((folder / part).glob("*.safetensors")):
            mend = "weights are read from safetensors alone: convert pickled ones first"
            raise TronError(f"the RGB->X checkpoint has no safetensors in {part}", folder, mend)
    return folder

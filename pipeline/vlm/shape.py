"""How many feature slots of which width a model gives, without its weights or transformers."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import could_be_hub_id, read_config
from pipeline.vlm.slots import slots_of

_WIDTH_OF_3B = 2048
"""Of the hidden states of Qwen2.5-VL-3B."""

_MANY_LAYERS = 10_000
"""How many layers a model has decides which of them are read, not how many slots."""


def feature_shape(vlm: VLMParams, views: Sequence[str]) -> tuple[int, int]:
    """Slots, and width: what a checkpoint folder says of itself, Qwen2.5-VL-3B's for a hub id.

    Raises `VLMError` for what is neither, and for a name in a folder that is here and lacks it.
    """
    slots = len(slots_of(vlm, _MANY_LAYERS, views))
    folder = Path(vlm.checkpoint).expanduser()
    if not folder.is_dir():
        if folder.parent.is_dir() or not could_be_hub_id(vlm.checkpoint):
            raise VLMError(
                f"{vlm.checkpoint}: no such folder. Expected a checkpoint's folder or a hub id, as "
                "Qwen/Qwen2.5-VL-3B-Instruct. The demo's is written by `python -m stages.demo`."
            )
        return slots, _WIDTH_OF_3B
    config = read_config(folder)
    return slots, int(config.get("text_config", config)["hidden_size"])

"""The folder of a checkpoint or an adapter: its files, and what must never run or leave it.

transformers and peft read the documents themselves, after the checks of this module.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue
from safetensors import safe_open

from pipeline.base.config import VLMParams
from pipeline.base.documents import Border, Document
from pipeline.base.errors import VLMError
from pipeline.base.hub import could_be_hub_id
from pipeline.base.printed_commands import command
from pipeline.base.provenance import TunedOn, join_tuned_on, read_tuned_on

VLMS = Border(
    VLMError,
    "Copy or download the checkpoint again, or set vlm.checkpoint to another Qwen2.5-VL.",
)
ADAPTERS = Border(
    VLMError,
    "Set vlm.adapter to a LoRA adapter of this checkpoint, saved by `save_pretrained`, or null.",
)

_WANTED = ["*.json", "*.safetensors", "*.txt", "*.jinja"]
"""Files that are downloaded from the hub; never a pickle."""

_DTYPES = {"F32", "F16", "BF16"}
"""The allowed dtypes of weights, in safetensors' names."""

_WHOLE, _INDEX = "model.safetensors", "model.safetensors.index.json"

_QUANTIZED = "quantization_config"
_REFUSED = {
    "auto_map": "",
    _QUANTIZED: "",
    "attn_implementation": "/",
    "_attn_implementation": "/",
    "_experts_implementation": "/",
}
"""Refused config keys, if their value has this text; a slash would download and run a kernel."""
_PLAIN = "weights of float32, float16 or bfloat16 and no code of the checkpoint's own"


def resolve_checkpoint(
    checkpoint: str, revision: str | None = None, setting: str = "vlm.checkpoint"
) -> Path:
    """The folder of a checkpoint or an adapter.

    An existing folder is used without network access. Anything else is a hub id: its cached copy if
    that is complete, otherwise a download. Raises `VLMError` when there is neither.
    """
    if folder := folder_here(checkpoint):
        return folder
    if not could_be_hub_id(checkpoint):
        raise VLMError(
            f"{setting} {checkpoint:.200}: no such folder. Expected a folder in the hub's format "
            "(a JSON config and *.safetensors) or a hub id such as Qwen/Qwen2.5-VL-3B-Instruct. "
            f"Set {setting} to one; `{command('demo')}` writes the demo's checkpoint."
        )
    return cached_checkpoint(checkpoint, revision) or _downloaded(checkpoint, revision, setting)


def folder_here(checkpoint: str) -> Path | None:
    """The folder of this name; None where there is none, for any text."""
    try:
        folder = Path(checkpoint).expanduser()
        return folder if folder.is_dir() else None
    except (OSError, RuntimeError, ValueError):  # too long, unknown user, or cannot be encoded
        return None


def cached_checkpoint(checkpoint: str, revision: str | None) -> Path | None:
    """The complete copy of a hub id in the hub's local cache, or None; uses no network."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        copy = snapshot_download(
            checkpoint, revision=revision, local_files_only=True, allow_patterns=_WANTED
        )
    except (LocalEntryNotFoundError, HFValidationError):
        return None
    # An interrupted download leaves an incomplete folder: complete it, do not use it.
    return Path(copy) if _is_complete(Path(copy)) else None


def _is_complete(folder: Path) -> bool:
    if (folder / "adapter_config.json").exists():
        return (folder / "adapter_model.safetensors").exists()
    try:
        _present_weights(folder)
        tokenizer_files(folder)
    except VLMError:
        return False
    return all((folder / f"{name}config.json").exists() for name in ("", "preprocessor_"))


def _downloaded(checkpoint: str, revision: str | None, setting: str) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    try:
        return Path(snapshot_download(checkpoint, revision=revision, allow_patterns=_WANTED))
    except (HFValidationError, OSError) as error:
        why = str(error).strip().splitlines()[0].rstrip(".")
        raise VLMError(
            f"{setting} {checkpoint:.200}: there is no folder of that name here; and as a hub id, "
            f"it cannot be downloaded: {why}. If it is the demo's folder, run "
            f"`{command('demo')}`; if it is a hub id, run `hf download {checkpoint}` where there "
            f"is network and set {setting} to the folder. `{command('doctor')}` looks at the rest."
        ) from error


def tuned_on(vlm: VLMParams) -> TunedOn | None:
    """What the model of `vlm` was tuned on; None where neither checkpoint nor adapter says.

    Raises `VLMError` where a folder is missing, `CheckpointIncomplete` where its file is damaged.
    """
    folders = [resolve_checkpoint(vlm.checkpoint, vlm.revision)]
    if vlm.adapter:
        folders.append(resolve_checkpoint(vlm.adapter, setting="vlm.adapter"))
    return join_tuned_on(map(read_tuned_on, folders))


class _Config(Document):
    """config.json, as far as transformers would read that of another model too."""

    model_type: Literal["qwen2_5_vl"]


class _WeightIndex(Document):
    weight_map: dict[str, Annotated[str, Field(pattern=r"^[^/\x00\\]+\.safetensors$")]]


class _AdapterConfig(Document):
    """adapter_config.json, before peft reads it. Other kinds and keys would let peft import
    modules, or load models from other folders or the hub."""

    peft_type: Literal["LORA"]
    megatron_config: None = None
    arrow_config: None = None


def read_config(folder: Path) -> Any:
    """The checkpoint's `Qwen2_5_VLConfig`, as transformers reads config.json.

    Raises `VLMError` like `check_documents`, where transformers cannot read it, and where its sizes
    do not fit each other, which would otherwise fail only when features are computed.
    """
    from transformers import Qwen2_5_VLConfig  # takes seconds to import

    check_documents(folder)
    path = folder / "config.json"
    what = "cannot be read as the config of a Qwen2.5-VL"
    quiet_transformers()
    with VLMS.foreign(path, what):
        config: Any = Qwen2_5_VLConfig.from_pretrained(
            folder, local_files_only=True, trust_remote_code=False
        )
        text, vision = config.text_config, config.vision_config
        head = text.hidden_size // text.num_attention_heads
        sections = text.rope_parameters["mrope_section"]
        blocks, heads = vision.fullatt_block_indexes, vision.num_heads
        merged = vision.patch_size * vision.spatial_merge_size
        for what, fits in {
            f"three mrope_section that sum to half a head of {head}, found {sections}": (
                len(sections) == 3 and 2 * sum(sections) == head
            ),
            f"head_dim to be {head}": getattr(text, "head_dim", None) in (None, head),
            f"4 x num_heads {heads} to divide hidden_size": vision.hidden_size % (4 * heads) == 0,
            f"fullatt_block_indexes {blocks} below depth {vision.depth}": (
                max(blocks, default=0) < vision.depth
            ),
            f"window_size {vision.window_size} of {merged} or more": vision.window_size >= merged,
        }.items():
            if not fits:
                raise VLMS.refusal(path, f"expected {what}")
    return config


def check_documents(folder: Path) -> None:
    """Raise `VLMError` unless a checkpoint is a Qwen2.5-VL, not quantized, without its own code,
    whose documents, templates and texts are regular files."""
    small_files(folder)
    VLMS.read_json(folder / "config.json", _Config)
    _refuse_code(folder, VLMS)


def small_files(folder: Path) -> list[Path]:
    """Every document, template and text of a folder, sorted; `VLMError` for a non-file."""
    beside = (*folder.glob("*"), *folder.glob("additional_chat_templates/*"))
    files = sorted(path for path in beside if path.suffix in (".json", ".jinja", ".txt"))
    for path in files:
        VLMS.check_file(path)
    return files


def quiet_transformers() -> None:
    """Keep transformers' reports off stderr, and its progress bars too unless that is a terminal.

    This project checks what they warn of, and raises `VLMError`.
    """
    from transformers.utils import logging

    logging.set_verbosity_error()
    if not sys.stderr.isatty():
        logging.disable_progress_bar()


def _refuse_code(folder: Path, border: Border) -> None:
    """Raise `VLMError` where a checkpoint or an adapter names its own code, or is quantized."""
    for path in sorted(folder.glob("*config.json")):
        document = border.read_json(path, dict[str, JsonValue])
        for key, value in _entries(document):
            refused = key in _REFUSED and (border is VLMS or key != _QUANTIZED)
            if value and refused and _REFUSED[key] in str(value):
                why = f"expected {_PLAIN}, found {key} {json.dumps(value):.200}"
                raise border.refusal(path, why)


def _entries(document: JsonValue) -> Iterator[tuple[str, JsonValue]]:
    """Each (key, value) at any depth of a JSON document; the key is '' in a list."""
    inside = document if isinstance(document, list | dict) else ()
    for entry in inside.items() if isinstance(inside, dict) else (("", item) for item in inside):
        yield entry
        yield from _entries(entry[1])


def tensor_shapes(files: Sequence[Path], border: Border = VLMS) -> dict[str, list[int]]:
    """Shape of each tensor in the safetensors files among these; reads no weight.

    Raises `VLMError` where a file is truncated or damaged, and where a tensor is not float, because
    it would be loaded as if it were.
    """
    shapes: dict[str, list[int]] = {}
    for path in (path for path in files if path.suffix == ".safetensors"):
        border.check_file(path)
        with border.foreign(path, "cut off or damaged"), safe_open(path, "numpy") as file:
            tensors = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            dtypes = {name: tensor.get_dtype() for name, tensor in tensors.items()}
        other = [f"{name} of {dtype}" for name, dtype in dtypes.items() if dtype not in _DTYPES]
        if other:
            why = f"expected {_PLAIN}, found {len(other)} of others, such as {other[0]}"
            raise border.refusal(path, why)
        shapes |= {name: tensor.get_shape() for name, tensor in tensors.items()}
    return shapes


def weight_files(folder: Path) -> list[Path]:
    """Every file that decides the weights, sorted: config.json, safetensors and their index.

    Raises `VLMError` where there are no weights, where the index names a missing file, where a file
    is damaged, and where weights are not float32, float16 or bfloat16.
    """
    if (folder / "adapter_config.json").exists():
        raise VLMError(
            f"{folder}: holds an adapter_config.json, so transformers could load an adapter "
            "unasked. Move the adapter to a folder of its own and name that as vlm.adapter."
        )
    files = _present_weights(folder)
    check_documents(folder)
    tensor_shapes(files)
    return files


def _present_weights(folder: Path) -> list[Path]:
    """The files that transformers loads: `model.safetensors`, or else the shards of an index."""
    weights = {path.name for path in folder.glob("*.safetensors")}
    if not weights:
        why = "no *.safetensors file; pickled weights (*.bin, *.pt) are not opened"
        raise VLMS.refusal(folder, why)
    if _WHOLE in weights:
        return sorted(folder / name for name in {_WHOLE, "config.json"})
    listed = set(VLMS.read_json(folder / _INDEX, _WeightIndex).weight_map.values())
    if missing := sorted(listed - weights):
        why = f"names {len(listed)} weight files, missing: {', '.join(missing)}"
        raise VLMS.refusal(folder / _INDEX, why)
    return sorted(folder / name for name in listed | {"config.json", _INDEX})


def tokenizer_files(folder: Path) -> list[Path]:
    """Every file that decides the tokens, sorted; `VLMError` where there is no tokenizer."""
    whole = folder / "tokenizer.json"
    content = [whole] if whole.exists() else [folder / "vocab.json", folder / "merges.txt"]
    if not all(path.exists() for path in content):
        why = "no tokenizer: expected tokenizer.json, or vocab.json with merges.txt"
        raise VLMS.refusal(folder, why)
    extra = [folder / name for name in ("tokenizer_config.json", "added_tokens.json")]
    return sorted([*content, *(path for path in extra if path.exists())])


def adapter_files(folder: Path) -> list[Path]:
    """The files that decide an adapter's effect, sorted.

    Raises `VLMError` where one is missing or damaged, where the adapter is not LoRA or names its
    own code, and where its weights are not float.
    """
    files = [folder / "adapter_config.json", folder / "adapter_model.safetensors"]
    ADAPTERS.read_json(files[0], _AdapterConfig)
    _refuse_code(folder, ADAPTERS)
    tensor_shapes(files, ADAPTERS)
    return files

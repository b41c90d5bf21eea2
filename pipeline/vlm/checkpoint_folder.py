"""Where a checkpoint or an adapter lies on disk, and which of its files decide what it says."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.base.tuned_on import TunedOn, joined, read_tuned_on

_WANTED = ["*.json", "*.safetensors", "*.txt", "*.jinja"]
"""What is fetched from the hub: never a pickle."""

_DTYPES = {"F32", "F16", "BF16"}
"""What safetensors calls the dtypes that weights may have."""

_INDEX = "model.safetensors.index.json"


def resolve_checkpoint(
    checkpoint: str, revision: str | None = None, setting: str = "vlm.checkpoint"
) -> Path:
    """The folder of a checkpoint or an adapter.

    An existing folder is taken as it is and no network is touched. Anything else is a hub id: its
    cached copy where complete, otherwise a download. Raises `VLMError` when neither is there.
    """
    folder = Path(checkpoint).expanduser()
    if folder.is_dir():
        return folder
    if not could_be_hub_id(checkpoint):
        raise VLMError(
            f"{setting} {checkpoint}: no such folder. Expected a folder in the hub's format (a "
            "JSON config and *.safetensors) or a hub id such as Qwen/Qwen2.5-VL-3B-Instruct. The "
            "demo's checkpoint is written by `python -m stages.demo`."
        )
    return cached_checkpoint(checkpoint, revision) or _downloaded(checkpoint, revision, setting)


def could_be_hub_id(checkpoint: str) -> bool:
    """Whether a text has the form of one: an owner and a name."""
    parts = checkpoint.split("/")
    return len(parts) == 2 and all(parts) and parts[0][0] not in ".~"


def cached_checkpoint(checkpoint: str, revision: str | None) -> Path | None:
    """The complete copy of a hub id in the hub's local cache, if there is one; no network."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        copy = snapshot_download(
            checkpoint, revision=revision, local_files_only=True, allow_patterns=_WANTED
        )
    except (LocalEntryNotFoundError, HFValidationError):
        return None
    # A download that was cut short leaves a folder with holes: it is finished, not trusted.
    return Path(copy) if _is_complete(Path(copy)) else None


def _is_complete(folder: Path) -> bool:
    if (folder / "adapter_config.json").exists():
        return (folder / "adapter_model.safetensors").exists()
    try:
        _present_weights(folder)
        tokenizer_files(folder)
    except VLMError:
        return False
    return (folder / "preprocessor_config.json").exists()


def _downloaded(checkpoint: str, revision: str | None, setting: str) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(checkpoint, revision=revision, allow_patterns=_WANTED))
    except LocalEntryNotFoundError as error:
        cause, why = error, "it is neither whole in the local cache nor reachable"
    except (HFValidationError, OSError) as error:
        cause, why = error, f"it cannot be downloaded: {str(error).strip().splitlines()[0]}"
    raise VLMError(
        f"{setting} {checkpoint}: there is no folder of that name here; and as a hub id, {why}. "
        "If it is the demo's folder, run `python -m stages.demo`; if it is a hub id, run "
        f"`hf download {checkpoint}` where there is network and set {setting} to the folder. "
        "`python -m stages.doctor` looks at the rest."
    ) from cause


def tuned_on(vlm: VLMParams) -> TunedOn | None:
    """What the model of `vlm` was tuned on; None where neither checkpoint nor adapter says it.

    Raises `VLMError` where one is missing, `CheckpointIncomplete` where what it says is damaged.
    """
    folders = [resolve_checkpoint(vlm.checkpoint, vlm.revision)]
    if vlm.adapter:
        folders.append(resolve_checkpoint(vlm.adapter, setting="vlm.adapter"))
    return joined(map(read_tuned_on, folders))


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a checkpoint's file; `VLMError` where it is missing or is not one."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        document = error
    if not isinstance(document, dict):
        raise VLMError(
            f"{path}: cannot be read as JSON, expected an object, found {document!r:.200}. Copy or "
            "download the checkpoint again."
        )
    return document


def read_config(folder: Path) -> dict[str, Any]:
    """The checkpoint's config.json.

    Raises `VLMError` unless it is a Qwen2.5-VL without code of its own and without quantization.
    """
    config = read_json(folder / "config.json")
    if config.get("model_type") != "qwen2_5_vl":
        raise VLMError(
            f"{folder / 'config.json'}: expected model_type 'qwen2_5_vl', found "
            f"{config.get('model_type')!r}. Set vlm.checkpoint to a Qwen2.5-VL checkpoint."
        )
    _refuse_code(folder)
    for quantization in _entries(config, "quantization_config"):
        raise VLMError(
            f"{folder / 'config.json'}: expected weights of float32, float16 or bfloat16, found "
            f"a quantization_config: {json.dumps(quantization):.200}. Set vlm.checkpoint to the "
            "checkpoint that was quantized, or save this one dequantized."
        )
    return config


def _refuse_code(folder: Path) -> None:
    """Raise `VLMError` where a checkpoint or an adapter names Python code of its own."""
    for path in sorted(folder.glob("*config.json")):
        for code in _entries(read_json(path), "auto_map"):
            raise VLMError(
                f"{path}: the checkpoint carries code of its own, which this project never runs: "
                f"its auto_map names {json.dumps(code):.200}. Take a checkpoint (or adapter) that "
                "transformers' own classes read; if you know that the code changes no feature, "
                "remove auto_map and name transformers' own class."
            )


def _entries(document: Any, key: str) -> Iterator[Any]:
    """What stands under this key at any depth of a JSON document, if it is not empty."""
    if isinstance(document, dict) and document.get(key):
        yield document[key]
    inside = document.values() if isinstance(document, dict) else document
    if isinstance(document, dict | list):
        for value in inside:
            yield from _entries(value, key)


def tensor_headers(path: Path) -> dict[str, tuple[str, list[int]]]:
    """Dtype, as safetensors calls it, and shape of each tensor of a file; no weight is read.

    Raises `VLMError` where the file is cut off or damaged.
    """
    try:
        with safe_open(path, "numpy") as file:
            tensors = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            return {
                name: (tensor.get_dtype(), tensor.get_shape()) for name, tensor in tensors.items()
            }
    except SafetensorError as error:
        raise VLMError(f"{path}: cut off or damaged: {error}. Copy or download it again.") from None


def _refuse_other_dtypes(files: Sequence[Path]) -> None:
    """Raise `VLMError` where a weight is no float, which would be loaded as if it were one."""
    for path in (path for path in files if path.suffix == ".safetensors"):
        headers = tensor_headers(path).items()
        other = [f"{name} of {dtype}" for name, (dtype, _) in headers if dtype not in _DTYPES]
        if other:
            raise VLMError(
                f"{path}: expected weights of float32, float16 or bfloat16 (F32, F16, BF16), "
                f"found {len(other)} of {len(headers)} tensors of another dtype, such as "
                f"{other[0]}. Take the checkpoint that was quantized, or save this one dequantized."
            )


def weight_files(folder: Path) -> list[Path]:
    """Every file that decides the weights, sorted: config.json, safetensors and their index.

    Raises `VLMError` where there is none, where the index names a file that is missing, where
    transformers would load other files than these, where a file is damaged, and where weights are
    not float32, float16 or bfloat16.
    """
    if (folder / "adapter_config.json").exists():
        raise VLMError(
            f"{folder}: holds an adapter_config.json, so transformers could load an adapter "
            "unasked. Move the adapter to a folder of its own and name that as vlm.adapter."
        )
    files, whole = _present_weights(folder), folder / "model.safetensors"
    shards = {path for path in files if path.suffix == ".safetensors"}
    # transformers loads model.safetensors and passes the index over.
    if folder / _INDEX in files and whole.exists() and shards != {whole}:
        raise VLMError(
            f"{folder}: ambiguous: it has both {whole.name} and {_INDEX}, which names other "
            f"files. Remove {whole.name} if the shards are the checkpoint, else {_INDEX} and the "
            "shards."
        )
    read_config(folder)
    _refuse_other_dtypes(files)
    return files


def _present_weights(folder: Path) -> list[Path]:
    weights = {path.name for path in folder.glob("*.safetensors")}
    listed = weights
    if (folder / _INDEX).exists():
        listed = {str(name) for name in read_json(folder / _INDEX).get("weight_map", {}).values()}
    if missing := sorted(listed - weights):
        raise VLMError(
            f"{folder}: {_INDEX} names {len(listed)} weight files, missing: "
            f"{', '.join(missing)}. Copy or download the checkpoint again."
        )
    if not listed:
        raise VLMError(
            f"{folder}: no *.safetensors file. Expected a checkpoint in the hub's format; pickled "
            "weights (*.bin, *.pt) are not opened."
        )
    read_json(folder / "config.json")
    beside = (name for name in ("config.json", _INDEX) if (folder / name).exists())
    return sorted(folder / name for name in (*listed, *beside))


def tokenizer_files(folder: Path) -> list[Path]:
    """Every file that decides the tokens, sorted; `VLMError` where there is no tokenizer."""
    whole = folder / "tokenizer.json"
    content = [whole] if whole.exists() else [folder / "vocab.json", folder / "merges.txt"]
    if not all(path.exists() for path in content):
        raise VLMError(
            f"{folder}: no tokenizer: expected tokenizer.json (or vocab.json with merges.txt). "
            "Copy or download the checkpoint again."
        )
    extra = [folder / name for name in ("tokenizer_config.json", "added_tokens.json")]
    return sorted([*content, *(path for path in extra if path.exists())])


def adapter_files(folder: Path) -> list[Path]:
    """The files that decide what an adapter adds, sorted.

    Raises `VLMError` where one is missing or damaged, or its weights are no floats.
    """
    files = [folder / "adapter_config.json", folder / "adapter_model.safetensors"]
    for path in (path for path in files if not path.exists()):
        raise VLMError(
            f"{path}: no such file. Expected a peft adapter folder with adapter_config.json "
            "and adapter_model.safetensors (save it with `save_pretrained`)."
        )
    _refuse_code(folder)
    _refuse_other_dtypes(files)
    return files

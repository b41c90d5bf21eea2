"""Where a checkpoint or an adapter lies on disk, which of its files decide what it says, and what
they may say."""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AliasChoices, Field, JsonValue, Strict, model_validator
from safetensors import safe_open

from pipeline.base.border import MOST_BYTES, Border, Document, Text, shown
from pipeline.base.commands import command
from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.base.tuned_on import TunedOn, joined, read_tuned_on

T = TypeVar("T")

VLMS = Border(
    VLMError,
    "Copy or download the checkpoint again, or set vlm.checkpoint to another Qwen2.5-VL.",
)
ADAPTERS = Border(
    VLMError,
    "Set vlm.adapter to a LoRA adapter of this checkpoint, saved by `save_pretrained`, or null.",
)

_WANTED = ["*.json", "*.safetensors", "*.txt", "*.jinja"]
"""What is fetched from the hub: never a pickle."""

_DTYPES = {"F32", "F16", "BF16"}
"""What safetensors calls the dtypes that weights may have."""

_INDEX = "model.safetensors.index.json"

_LOADED = re.compile(r"config|token|vocab|merges|template|index")
"""In the names of what transformers reads; a trainer leaves others, of any size."""

_QUANTIZED = "quantization_config"
_REFUSED = {
    "auto_map": "",
    _QUANTIZED: "",
    "attn_implementation": "/",
    "_attn_implementation": "/",
    "_experts_implementation": "/",
}
"""Keys of a config by what their values hold: with a slash, a kernel would be fetched and run."""
_PLAIN = "weights of float32, float16 or bfloat16 and no code of the checkpoint's own"


def resolve_checkpoint(
    checkpoint: str, revision: str | None = None, setting: str = "vlm.checkpoint"
) -> Path:
    """The folder of a checkpoint or an adapter.

    An existing folder is taken as it is and no network is touched. Anything else is a hub id: its
    cached copy where complete, otherwise a download. Raises `VLMError` when neither is there.
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
    """The folder of this name, if it is one; whatever the text is."""
    try:
        folder = Path(checkpoint).expanduser()
        return folder if folder.is_dir() else None
    except (OSError, RuntimeError, ValueError):  # too long, of no user, not to be encoded
        return None


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
    """What the model of `vlm` was tuned on; None where neither checkpoint nor adapter says it.

    Raises `VLMError` where one is missing, `CheckpointIncomplete` where what it says is damaged.
    """
    folders = [resolve_checkpoint(vlm.checkpoint, vlm.revision)]
    if vlm.adapter:
        folders.append(resolve_checkpoint(vlm.adapter, setting="vlm.adapter"))
    return joined(map(read_tuned_on, folders))


_List = Annotated[tuple[T, ...], Strict(False)]
_Triple = Annotated[_List[T], Field(min_length=3, max_length=3)]
_Count = Annotated[int, Field(ge=1, le=10**6)]
_Layers = Annotated[int, Field(ge=1, le=512)]
_Pixels = Annotated[int, Field(ge=1, le=10**9)]
_Positive = Annotated[int | float, Field(gt=0, le=1e9)]
_MATCHING_S = 5.0
QWENS = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*"
    r"|\s*[\r\n]+|\s+(?!\S)|\s+"
)
"""The pattern by which Qwen2's tokenizers split a text into words."""


class _Settings(Document):
    """Part of config.json."""

    # transformers makes a list of so many.
    num_labels: Annotated[int, Field(ge=0, le=1000)] | None = None


class _Rope(Document):
    """Rotary positions."""

    mrope_section: _Triple[_Count] = (16, 24, 24)


class TextConfig(_Settings):
    """The decoder; what the released checkpoints say and transformers' default is not must stand
    there."""

    hidden_size: _Count
    num_hidden_layers: _Layers
    num_attention_heads: _Count
    head_dim: _Count | None = None
    vocab_size: _Count
    max_position_embeddings: _Pixels
    rms_norm_eps: Annotated[float, Field(ge=0, le=1)]
    rope_scaling: _Rope | None = None
    rope_parameters: _Rope | None = None


class VisionConfig(_Settings):
    """The vision tower; the defaults are transformers' own, for a file may leave them out."""

    depth: _Layers = 32
    hidden_size: _Count = 3584
    num_heads: _Count = 16
    patch_size: _Count = 14
    spatial_merge_size: _Count = 2
    temporal_patch_size: _Count = 2
    window_size: Annotated[int, Field(ge=28, le=10_000)] = 112
    fullatt_block_indexes: _List[Annotated[int, Field(ge=0)]] = (7, 15, 23, 31)
    # transformers takes these for depth and num_heads.
    num_hidden_layers: None = None
    num_attention_heads: None = None


class VLMConfig(_Settings):
    """config.json."""

    model_type: Literal["qwen2_5_vl"]
    text_config: TextConfig
    vision_config: VisionConfig
    image_token_id: Annotated[int, Field(ge=0, le=10**6)] = 151655

    @model_validator(mode="before")
    @classmethod
    def _nested(cls, given: Any) -> Any:
        """The hub's configs are flat, those that transformers 5 writes are nested."""
        if isinstance(given, dict) and given.get("text_config") is None:
            return given | {"text_config": given}
        return given

    @model_validator(mode="after")
    def _agrees(self) -> "VLMConfig":
        """What would otherwise fail while features are computed, or give others."""
        text, vision = self.text_config, self.vision_config
        head, blocks = text.hidden_size // text.num_attention_heads, vision.fullatt_block_indexes
        sections = (text.rope_scaling or text.rope_parameters or _Rope()).mrope_section
        silent = {"num_heads", "fullatt_block_indexes"} - vision.model_fields_set
        for what, fits in {
            f"mrope_section {sections} to sum to half a head of {head}": 2 * sum(sections) == head,
            f"head_dim {text.head_dim} to be {head}": text.head_dim in (None, head),
            f"4 x num_heads {vision.num_heads} to divide vision_config's hidden_size": (
                vision.hidden_size % (4 * vision.num_heads) == 0
            ),
            f"fullatt_block_indexes {blocks} below depth {vision.depth}": (
                max(blocks, default=0) < vision.depth
            ),
            f"{sorted(silent)} in vision_config": not silent or vision.hidden_size == 1280,
        }.items():
            if not fits:
                raise ValueError(f"expected {what}")
        return self


class _WeightIndex(Document):
    weight_map: dict[str, Annotated[str, Field(pattern=r"^[^/\x00\\]+\.safetensors$")]]


class _AdapterConfig(Document):
    """adapter_config.json; what peft would import, open or go on with for ever is refused."""

    r: _Count = 8
    rank_pattern: dict[Text, _Count] = Field(default_factory=dict)
    alpha_pattern: dict[Text, int | float] = Field(default_factory=dict)
    bias: Literal["none", "all", "lora_only"] = "none"
    # So short that `pissa_niter_` has three digits.
    init_lora_weights: bool | Annotated[str, Field(max_length=15)] | None = True
    loftq_config: dict[Text, Annotated[int, Field(le=100)]] | None = None
    layer_replication: None = None
    megatron_config: None = None
    arrow_config: None = None


class _Edges(Document):
    shortest_edge: _Pixels = Field(validation_alias=AliasChoices("shortest_edge", "min_pixels"))
    longest_edge: _Pixels = Field(validation_alias=AliasChoices("longest_edge", "max_pixels"))


class PreprocessorConfig(Document):
    """preprocessor_config.json of a Qwen2VLImageProcessor; the defaults are that processor's."""

    image_processor_type: Annotated[str, Field(pattern="^Qwen2VLImageProcessor")] | None = None
    do_resize: Literal[True] = True
    do_rescale: Literal[True] = True
    do_normalize: Literal[True] = True
    resample: Literal[3] = 3
    patch_size: _Count = 14
    merge_size: _Count = 2
    temporal_patch_size: _Count = 2
    rescale_factor: _Positive = 1 / 255
    image_mean: _Triple[int | float]
    image_std: _Triple[_Positive]
    size: _Edges = _Edges(shortest_edge=56 * 56, longest_edge=28 * 28 * 1280)
    min_pixels: _Pixels | None = None
    max_pixels: _Pixels | None = None


class _ProcessorConfig(Document):
    image_processor: PreprocessorConfig | None = None


class _BPE(Document):
    vocab: dict[str, int]
    merges: list[Any]


class _Tokenizer(Document):
    model: _BPE
    normalizer: JsonValue = None
    pre_tokenizer: JsonValue = None


_TOKENIZERS = r"^(Qwen2Tokenizer(Fast)?|PreTrainedTokenizerFast|TokenizersBackend)$"


class _TokenizerConfig(Document):
    tokenizer_class: Annotated[str, Field(pattern=_TOKENIZERS)] | None = None


class ChatTemplate(Document):
    """chat_template.json."""

    chat_template: str | None = None


def read_preprocessor(folder: Path) -> PreprocessorConfig:
    """What the image processor does; `VLMError` where its patches are not those of the model."""
    path, nested = folder / "preprocessor_config.json", folder / "processor_config.json"
    config = None
    if nested.exists():  # what transformers 5 writes goes first
        config = VLMS.read_json(nested, _ProcessorConfig).image_processor
    config = config or VLMS.read_json(path, PreprocessorConfig)
    vision = read_config(folder).vision_config
    ours = (config.patch_size, config.merge_size, config.temporal_patch_size)
    theirs = (vision.patch_size, vision.spatial_merge_size, vision.temporal_patch_size)
    if ours != theirs:
        why = f"expected patch, merge and temporal patch size {theirs} of config.json, found {ours}"
        raise VLMS.refusal(path, why)
    return config


def check_tokenizer(folder: Path) -> None:
    """Raise `VLMError` where a tokenizer's file cannot be read, is cut off or another model's."""
    small_files(folder)
    tokenizer_files(folder)
    if (path := folder / "tokenizer_config.json").exists():
        VLMS.read_json(path, _TokenizerConfig)
    if (where := folder / "tokenizer.json").exists():
        tokenizer = VLMS.read_json(where, _Tokenizer)
        model = tokenizer.model
        for key, pattern in _entries([tokenizer.normalizer, tokenizer.pre_tokenizer]):
            if key == "Regex" and pattern != QWENS:  # any other may go on for ever
                raise VLMS.refusal(where, f"expected Qwen2's pattern, found {shown(pattern)}")
    else:
        where, vocab = folder / "merges.txt", VLMS.read_json(folder / "vocab.json", dict[str, int])
        lines = filter(bytes.strip, VLMS.read_bytes(where).splitlines())
        merges = [line for line in lines if not line.startswith(b"#version:")]
        model = _BPE(vocab=vocab, merges=merges)
    # A merge makes each token of several characters, but for the control tokens.
    made = sum(len(token) > 1 and token[0] + token[-1] != "<>" for token in model.vocab)
    if len(model.merges) < made:
        why = f"cut off: expected {made} merges for its vocabulary, found {len(model.merges)}"
        raise VLMS.refusal(where, why)


def read_config(folder: Path) -> VLMConfig:
    """The checkpoint's config.json.

    Raises `VLMError` unless it is a Qwen2.5-VL without code of its own and without quantization.
    """
    config = VLMS.read_json(folder / "config.json", VLMConfig)
    _refuse_code(folder, VLMS)
    return config


def small_files(folder: Path) -> list[Path]:
    """Every document, template and text of a folder, sorted.

    Raises `VLMError` for what is no file, or one for transformers that is too large.
    """
    beside = (*folder.glob("*"), *folder.glob("additional_chat_templates/*"))
    files = sorted(path for path in beside if path.suffix in (".json", ".jinja", ".txt"))
    for path in files:
        VLMS.check_file(path, MOST_BYTES if _LOADED.search(path.name) else None)
    return files


def _refuse_code(folder: Path, border: Border) -> None:
    """Raise `VLMError` where a checkpoint or an adapter names code of its own, or quantized it."""
    for path in sorted(folder.glob("*config.json")):
        document = border.read_json(path, dict[str, JsonValue])
        for key, value in _entries(document):
            refused = key in _REFUSED and (border is VLMS or key != _QUANTIZED)
            if value and refused and _REFUSED[key] in str(value):
                why = f"expected {_PLAIN}, found {key} {json.dumps(value):.200}"
                raise border.refusal(path, why)


def _entries(document: JsonValue) -> Iterator[tuple[str, JsonValue]]:
    """What stands at any depth of a JSON document, with its key; in a list that is empty."""
    inside = document if isinstance(document, list | dict) else ()
    for entry in inside.items() if isinstance(inside, dict) else (("", item) for item in inside):
        yield entry
        yield from _entries(entry[1])


def tensor_shapes(files: Sequence[Path], border: Border = VLMS) -> dict[str, list[int]]:
    """Shape of each tensor of those of the files that hold weights; no weight is read.

    Raises `VLMError` where a file is cut off or damaged, where a tensor stands twice, and where one
    is no float, which would be loaded as if it were one.
    """
    shapes: dict[str, list[int]] = {}
    for path in (path for path in files if path.suffix == ".safetensors"):
        border.check_file(path)
        with border.foreign(path, "cut off or damaged"), safe_open(path, "numpy") as file:
            tensors = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            dtypes = {name: tensor.get_dtype() for name, tensor in tensors.items()}
        if twice := shapes.keys() & tensors:
            raise border.refusal(path, f"{min(twice)} stands in another file too")
        other = [f"{name} of {dtype}" for name, dtype in dtypes.items() if dtype not in _DTYPES]
        if other:
            why = f"expected {_PLAIN}, found {len(other)} of others, such as {other[0]}"
            raise border.refusal(path, why)
        shapes |= {name: tensor.get_shape() for name, tensor in tensors.items()}
    return shapes


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
    tensor_shapes(files)
    return files


def _present_weights(folder: Path) -> list[Path]:
    weights = {path.name for path in folder.glob("*.safetensors")}
    listed = weights
    if (folder / _INDEX).exists():
        listed = set(VLMS.read_json(folder / _INDEX, _WeightIndex).weight_map.values())
    if missing := sorted(listed - weights):
        why = f"names {len(listed)} weight files, missing: {', '.join(missing)}"
        raise VLMS.refusal(folder / _INDEX, why)
    if not listed:
        why = "no *.safetensors file; pickled weights (*.bin, *.pt) are not opened"
        raise VLMS.refusal(folder, why)
    beside = {"config.json", _INDEX} if (folder / _INDEX).exists() else {"config.json"}
    return sorted(folder / name for name in listed | beside)


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
    """The files that decide what an adapter adds, sorted.

    Raises `VLMError` where one is missing or damaged, or its weights are no floats.
    """
    files = [folder / "adapter_config.json", folder / "adapter_model.safetensors"]
    config = ADAPTERS.read_json(files[0], _AdapterConfig)
    _refuse_code(folder, ADAPTERS)
    shapes = tensor_shapes(files, ADAPTERS)
    widest = max((size for shape in shapes.values() for size in shape), default=0)
    if (rank := max([config.r, *config.rank_pattern.values()])) > widest:
        why = f"expected a rank of at most the widest tensor of its weights, {widest}, found {rank}"
        raise ADAPTERS.refusal(files[0], why)
    document = ADAPTERS.read_json(files[0], dict[str, JsonValue])
    texts = (text for entry in _entries(document) for text in entry if isinstance(text, str))
    where = f"{files[0]}: its patterns cannot be matched with its weights' names"
    with ADAPTERS.time_limit(where, _MATCHING_S):
        for pattern, name in product(texts, shapes):
            with suppress(re.error):  # a text that is no pattern
                re.match(rf"(.*\.)?({pattern})$", name)
    return files

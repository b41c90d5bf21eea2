"""The identity of a feature, computed without loading a weight.

Two features may be in one store only if their specs have the same digest. The attention backend and
library versions are not part of the spec, because they change a feature only within the noise of
its dtype.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pipeline.base.config import PCA, FeatureDtype, VLMParams, stored_as
from pipeline.base.differences import describe, differences
from pipeline.base.errors import VLMError
from pipeline.base.hub import could_be_hub_id
from pipeline.base.printed_commands import command
from pipeline.base.projection import Basis, group_sizes
from pipeline.base.provenance import Frames, row_key
from pipeline.vlm.checkpoint_folder import (
    adapter_files,
    folder_here,
    read_config,
    resolve_checkpoint,
    small_files,
    tokenizer_files,
    weight_files,
)
from pipeline.vlm.slots import Slot, slot_documents, slots_of

EXTRACTOR_VERSION = 1
"""Raise it whenever this code changes what a feature is; the golden-feature test enforces that."""

AUGMENTATION_VERSION = 1
"""Raise it whenever this code changes what an augmented variant of a frame is."""

_WIDTH_OF_3B = 2048
"""Width of the hidden states of Qwen2.5-VL-3B."""

_LAYERS_OF_3B = 36

_MANY_LAYERS = 10_000
"""A stand-in for an unknown number of layers, on which the number of slots does not depend."""

_PLACEHOLDER_INSTRUCTION = "…"
_READS_CHECKPOINTS = ("transformers", "tokenizers", "huggingface-hub", "jinja2")


@dataclass(frozen=True)
class FeatureSpec:
    """The identity of a feature, and the shape that follows from it."""

    document: dict[str, Any]
    """Everything that decides what a feature is, JSON-able."""
    digest: str
    """Hex digest of the document."""
    slots: tuple[Slot, ...]
    """The slots of one variant."""
    views: tuple[str, ...]
    dim: int
    image_size: tuple[int, int]
    """Final height and width of every frame, in pixels."""
    variants: int
    """How many times a row holds the slots: first for the plain frames, then for augmented ones."""
    whole: "FeatureSpec | None" = None
    """The model's own features, where these are a projection of them."""
    basis: Basis | None = None
    """The projection; None where there is none, or where it has yet to be fitted."""

    @property
    def groups(self) -> tuple[int, ...]:
        """How many slots each group of one variant has, in order."""
        return group_sizes([slot.document() for slot in self.slots])

    @property
    def unfitted(self) -> bool:
        """Whether the features are a projection whose basis is not known yet."""
        return self.whole is not None and self.basis is None

    def on(self, basis: Basis) -> "FeatureSpec":
        """The spec of the same projection on this basis."""
        assert self.whole is not None, "a spec of the model's own features has no basis"
        pca = self.document["pca"] | {"basis": basis.digest}
        document = self.document | {"pca": pca}
        return replace(self, document=document, digest=_digest(document), basis=basis)

    def attrs(self) -> dict[str, Any]:
        """The document with its digest, as a store keeps it."""
        return {"digest": self.digest, **self.document}

    def row_key(self, prompt: str, frames: Frames) -> bytes:
        """16 bytes that differ for every other spec, rendered prompt or decoded frames."""
        return row_key(self.digest, self.views, prompt, frames)


def feature_spec(
    vlm: VLMParams,
    dtype: FeatureDtype,
    views: Sequence[str],
    digest_file: Callable[[Path], str],
    remember: Callable[[str, Callable[[], str]], str] | None = None,
    basis: Basis | None = None,
) -> FeatureSpec:
    """The spec of the features of `vlm` for these views, stored as `dtype`, on this basis.

    Reads the checkpoint's small files; `digest_file` returns the content digest of one file and may
    remember it. `remember` (`ContentDigests.text`) may keep the result under the digest of all its
    inputs; then transformers, which takes seconds to import, is not needed again. Raises `VLMError`
    where the checkpoint is incomplete, `vlm.layers` goes past it, or a projection is wider than it.
    """
    folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
    ordered = tuple(sorted(set(views)))
    adapter = resolve_checkpoint(vlm.adapter, setting="vlm.adapter") if vlm.adapter else None

    def read() -> str:
        return json.dumps(_read(folder, vlm, len(ordered)))

    what = _read_digest(folder, vlm, len(ordered), digest_file) if remember else ""
    rendered = json.loads(remember(what, read) if remember else read())
    processor, dim = rendered["processor"], rendered["dim"]
    sides, patch = processor["image_size"], processor["patch_size"] * processor["merge_size"]
    slots = slots_of(vlm, rendered["layers"], ordered, (sides[0] // patch, sides[1] // patch))
    document = {
        "extractor_version": EXTRACTOR_VERSION,
        "weights": _files_digest(weight_files(folder), digest_file),
        "adapter": adapter and _files_digest(adapter_files(adapter), digest_file),
        "tokenizer": _files_digest(tokenizer_files(folder), digest_file),
        "chat_template": rendered["chat_template"],
        "prompt": vlm.prompt,
        "example_prompt": rendered["example_prompt"],
        "processor": processor,
        "views": list(ordered),
        "slots": slot_documents(slots, vlm.variants),
        "dim": dim,
        "compute_dtype": vlm.dtype,
        "storage_dtype": stored_as(dtype),
        **_augmentation(vlm),
    }
    digest = _digest(document)
    image_size = processor["image_size"][0], processor["image_size"][1]
    spec = FeatureSpec(document, digest, slots, ordered, dim, image_size, vlm.variants)
    if not isinstance(dtype, PCA):
        return spec
    if dtype.pca > dim:
        raise VLMError(
            f"extract.dtype {dtype}: the hidden states of {vlm.checkpoint} have only {dim} "
            f"numbers. Set pca to at most {dim}."
        )
    document = document | {"dim": dtype.pca, "pca": {"of": dim, "basis": None}}
    projected = replace(
        spec, document=document, digest=_digest(document), dim=dtype.pca, whole=spec
    )
    return projected if basis is None else projected.on(basis)


def dtype_of(spec: Mapping[str, Any]) -> FeatureDtype:
    """The value of `extract.dtype` that gave a stored spec."""
    stored = spec["storage_dtype"]
    return PCA(pca=spec["dim"], then=stored) if "pca" in spec else stored


def feature_shape(vlm: VLMParams, views: Sequence[str]) -> tuple[int, int]:
    """(slots, width) of the features; for a hub id width and layers are those of Qwen2.5-VL-3B.

    Raises `VLMError` for a checkpoint that is neither a folder nor a hub id, also for a name whose
    parent is a folder here but that does not exist.
    """
    folder = folder_here(vlm.checkpoint)
    tokens = round(vlm.image_resize_height / 28), round(vlm.image_resize_width / 28)  # of the 3B
    if folder and "tokens" in vlm.pooling:
        from pipeline.vlm.processor import PixelSettings

        tokens = PixelSettings.of(vlm).merged_grid
    text = read_config(folder).text_config if folder else None
    every = text.num_hidden_layers if text else _LAYERS_OF_3B
    slots = len(slots_of(vlm, every if vlm.layers == "all" else _MANY_LAYERS, views, tokens))
    if text:
        return slots, text.hidden_size
    if folder_here(str(Path(vlm.checkpoint).parent)) or not could_be_hub_id(vlm.checkpoint):
        raise VLMError(
            f"{vlm.checkpoint}: no such folder, and no hub id. The demo's checkpoint is written by "
            f"`{command('demo')}`."
        )
    return slots, _WIDTH_OF_3B


def _read(folder: Path, vlm: VLMParams, views: int) -> dict[str, Any]:
    """What only transformers can read: entries of the document, and the number of layers."""
    from pipeline.vlm.processor import PixelSettings, PromptRenderer

    renderer, text = PromptRenderer(folder, vlm.prompt), read_config(folder).text_config
    return {
        "layers": text.num_hidden_layers,
        "dim": text.hidden_size,
        "chat_template": renderer.chat_template,
        "example_prompt": renderer.render(_PLACEHOLDER_INSTRUCTION, views),
        "processor": PixelSettings.of(vlm).document(),
    }


def _read_digest(
    folder: Path, vlm: VLMParams, views: int, digest_file: Callable[[Path], str]
) -> str:
    """The digest of all that `_read` depends on: files, libraries, this code and its arguments."""
    names = ("checkpoint_folder.py", "feature_spec.py", "processor.py")
    code = [Path(__file__).with_name(name) for name in names]
    return _digest(
        {
            "files": {str(p.relative_to(folder)): digest_file(p) for p in small_files(folder)},
            "libraries": {name: version(name) for name in _READS_CHECKPOINTS},
            "code": [digest_file(path) for path in code],
            "resize": (vlm.image_resize_height, vlm.image_resize_width),
            "prompt": vlm.prompt,
            "views": views,
        }
    )


def live_differences(trained: Mapping[str, Any], live: Mapping[str, Any]) -> list[str]:
    """A line for each entry that differs between the spec of a policy and that of a live model.

    The storage dtype and augmented variants do not count: a live model computes plain features.
    """
    return describe(differences(_as_live(trained), _as_live(live)))


def _as_live(spec: Mapping[str, Any]) -> dict[str, Any]:
    plain = [slot for slot in spec.get("slots", []) if slot.get("variant", 0) == 0]
    slots = [{name: value for name, value in slot.items() if name != "variant"} for slot in plain]
    other = {"digest", "storage_dtype", "variants", "augmentation"}
    return {name: value for name, value in spec.items() if name not in other} | {"slots": slots}


def _augmentation(vlm: VLMParams) -> dict[str, Any]:
    """The entries for augmented variants; empty without them, so that old digests stay."""
    if vlm.variants == 1:
        return {}
    how = {"version": AUGMENTATION_VERSION, **vlm.augmentation.model_dump()}
    return {"variants": vlm.variants, "augmentation": how}


def _files_digest(files: Sequence[Path], digest_file: Callable[[Path], str]) -> str:
    return _digest({path.name: digest_file(path) for path in files})


def _digest(document: Any) -> str:
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.blake2b(canonical.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()

"""The Qwen2.5-VL: prepared rows -> pooled features.

`Extractor` is the differentiable forward pass, which the frozen model here and the learning one of
`live` share.
"""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from transformers.masking_utils import create_causal_mask, create_sliding_window_causal_mask

from pipeline.base.config import Layer, VLMParams
from pipeline.base.errors import NumericsError, VLMError
from pipeline.base.hardware import resolve_device
from pipeline.base.packing import Stored, pack, scales
from pipeline.vlm.collation import Collator, TokenBatch
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.loading import environment, load_model
from pipeline.vlm.pooling import pool
from pipeline.vlm.preparation import PreparedRow, TokenLayout
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.slots import Slot
from pipeline.vlm.vision import VisionTower, pad_mlps

_SHAPES = 64
"""Most batch shapes that are compiled: tried sizes times prompt lengths times views."""


def layers_needed(slots: Iterable[Slot]) -> int:
    """How many decoder layers must run for these slots; none where all are of the vision tower."""
    return max(-1 if slot.layer == "vision" else slot.layer for slot in slots) + 1


class Extractor:
    """Collates rows, runs an inner `Qwen2_5_VLModel` and pools its layers' outputs.

    The caller decides whether gradients flow, and in which precision. Nothing waits for the device
    between a batch's first tensor and its features.
    """

    def __init__(
        self,
        model: Any,
        settings: PixelSettings,
        slots: tuple[Slot, ...],
        compiled: bool = False,
    ) -> None:
        """`model` may be cut after the last layer that a slot reads.

        With `compiled`, vision and text are each compiled completely, for static shapes.
        """
        self.model = model
        self._settings = settings
        # Every (layer, norm) has the same places, so one set of pooling weights is enough.
        reads: list[tuple[Layer, bool]] = [(slot.layer, slot.norm) for slot in slots]
        self._reads = tuple(dict.fromkeys(reads))
        places = slots[: len(slots) // len(self._reads)]
        self._tower = VisionTower(model.visual, settings.grid)
        self._collator = Collator(model, settings, places, self._tower, static=compiled)
        self._compiled: tuple[Callable[..., Tensor], ...] = ()
        if compiled:
            from torch._dynamo import config  # takes a second to import

            # After more shapes than this, dynamo would continue uncompiled, almost silently.
            config.recompile_limit = _SHAPES
            mode = "reduce-overhead" if model.device.type == "cuda" else None
            parts = (self._tower.__call__, self._read)
            self._compiled = tuple(torch.compile(p, dynamic=False, mode=mode) for p in parts)

    def extract(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
        """Features of each row, float32 on the model's device, and which are valid, on the CPU."""
        batch = self.collate(rows)
        return self.features(batch), self.valid(batch)

    def collate(self, rows: Sequence[PreparedRow]) -> TokenBatch:
        """The batch for `features`, sent to the model's device without waiting."""
        return self._collator.collate(rows)

    def valid(self, batch: TokenBatch) -> Bool[Tensor, "batch slot"]:
        """Which slots have at least one token; on the CPU."""
        return batch.arrangement.valid.repeat(1, len(self._reads))

    def features(self, batch: TokenBatch) -> Float[Tensor, "batch slot dim"]:
        """The slots of each row, in float32 on the model's device.

        A compiled extractor overwrites its result with its next batch.
        """
        if self._compiled:
            torch.compiler.cudagraph_mark_step_begin()
        see, read = self._compiled or (self._tower, self._read)
        places = batch.arrangement
        embedded = self.model.language_model.embed_tokens(batch.token_ids)
        if batch.plan is not None:
            patches = patchify(batch.pixels, self._settings).to(self.model.dtype)
            seen = see(patches, batch.plan).index_select(0, batch.shown)
            embedded.flatten(0, 1).index_copy_(0, places.image_tokens, seen.to(embedded.dtype))
        masks = self._masks(embedded)
        return read(embedded, places.positions, masks, places.weights, places.real)

    def _masks(self, embedded: Float[Tensor, "batch token dim"]) -> Mapping[str, Tensor | None]:
        """The mask of each kind of layer; None where the kernel itself is causal.

        Attention is causal and padding comes last, so no real token sees padding: a mask for it
        would only cost memory and prevent the fast causal kernel.
        """
        text = self.model.language_model
        # Passed by position, because a name differs between releases: no padding mask, no cache,
        # plain positions.
        given = (text.config, embedded, None, None, None)
        masks: dict[str, Any] = {"full_attention": create_causal_mask(*given)}
        if text.has_sliding_layers:
            masks["sliding_attention"] = create_sliding_window_causal_mask(*given)
        return masks

    def _read(
        self,
        embedded: Float[Tensor, "batch token dim"],
        positions: Int64[Tensor, "3 batch token"],
        masks: Mapping[str, Tensor | None],
        weights: Float[Tensor, "batch place token"],
        real: Bool[Tensor, "batch token"] | None,
    ) -> Float[Tensor, "batch slot dim"]:
        """Run the layers and pool each output at once, so that none is kept in memory."""
        text = self.model.language_model
        rotary = text.rotary_emb(embedded, positions)
        read: dict[tuple[Layer, bool], Tensor] = {}

        def keep(output: Layer, hidden: Float[Tensor, "batch token dim"]) -> None:
            for key in self._reads:
                if key[0] == output:
                    tokens = text.norm(hidden) if key[1] else hidden
                    # Sums over thousands of tokens stay in float32, whatever autocast the caller
                    # uses.
                    with torch.autocast(tokens.device.type, enabled=False):
                        read[key] = pool(tokens, weights, real)

        hidden = embedded
        keep("vision", embedded)  # its slots read image tokens only
        for number, layer in enumerate(text.layers):
            mask = masks[text.config.layer_types[number]]
            hidden = layer(hidden, attention_mask=mask, position_embeddings=rotary, use_cache=False)
            keep(number, hidden)
        return torch.cat([read[key] for key in self._reads], dim=1)


def patchify(
    images: UInt8[Tensor, "image height width 3"], settings: PixelSettings
) -> Float[Tensor, "patch value"]:
    """Normalised patches of all images (stretched, uint8), in float32 on the images' device.

    The layout is that of transformers' Qwen2-VL image processor.

    Patches are in the tower's order: blocks of merge size x merge size, row-major; the values of a
    patch are (channel, time, y, x), with the still image repeated over time.
    """
    rows, columns = settings.grid
    merge, patch = settings.merge_size, settings.patch_size
    blocks = images.reshape(
        -1, rows // merge, merge, patch, columns // merge, merge, patch, images.shape[-1]
    )
    # image, block row, block column, row in block, column in block, channel, y, x
    patches = blocks.permute(0, 1, 4, 2, 5, 7, 3, 6).to(torch.float32)
    scale, offset = _normalisation(settings, images.device)
    patches = torch.addcmul(offset, patches, scale)
    frames = patches.unsqueeze(6).expand(*[-1] * 6, settings.temporal_patch_size, -1, -1)
    return frames.reshape(len(images) * rows * columns, -1)


@lru_cache(maxsize=8)
def _normalisation(settings: PixelSettings, device: torch.device) -> tuple[Tensor, Tensor]:
    """Scale and offset of each channel (channel, 1, 1), so that one pass rescales and normalises.

    Cached, because sending them waits for the device.
    """
    mean, std = (
        torch.tensor(values, dtype=torch.float64).reshape(-1, 1, 1)
        for values in (settings.image_mean, settings.image_std)
    )
    scale, offset = settings.rescale_factor / std, -mean / std
    return scale.float().to(device), offset.float().to(device)


class FrozenVLM:
    """A loaded Qwen2.5-VL that turns prepared rows into pooled features, and never learns."""

    environment: dict[str, str]
    """Attention backend, library versions and device; recorded, but not part of the identity."""

    def __init__(
        self, model: Any, settings: PixelSettings, spec: FeatureSpec, compiled: bool = False
    ) -> None:
        """Wrap an inner `Qwen2_5_VLModel` that is already on its device."""
        self._model = model
        if model.device.type == "cuda":
            pad_mlps(model.visual)
        self._extractor = Extractor(model, settings, spec.slots, compiled)
        self._spec = spec
        self._storage_dtype: str = spec.document["storage_dtype"]
        self._compiled = compiled
        self._fitted: dict[TokenLayout, set[int]] = defaultdict(set)
        self.environment = environment(model) | ({"compiled": "true"} if compiled else {})

    @classmethod
    def load(
        cls, vlm: VLMParams, spec: FeatureSpec, device: str = "auto", compile: bool = False
    ) -> "FrozenVLM":
        """The checkpoint (and adapter) of `vlm` in its dtype, cut after the last layer needed.

        `device` is a torch device or "auto" (CUDA if there is one). With `compile`, the first batch
        of a shape takes minutes and later ones are faster. Raises `VLMError` where the folder is
        incomplete, a weight is missing or unexpected, or the adapter does not fit.
        """
        model = load_model(vlm, layers_needed(spec.slots), resolve_device(device))
        return cls(model, PixelSettings.of(vlm), spec, compile)

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self._model.device

    def encode(self, rows: Sequence[PreparedRow]) -> tuple[Stored, Bool[Tensor, "batch slot"]]:
        """Features of each row in the storage dtype, and which slots are valid, both on the CPU.

        A slot whose view is missing is zero and invalid. A row's features do not depend on the
        other rows, except for the compute dtype's noise; rows of equal `layout` are fastest. Raises
        `NumericsError`, which names row and slot, where a feature is NaN or infinite.
        """
        return self.submit(rows).result()

    @torch.no_grad()
    def submit(self, rows: Sequence[PreparedRow]) -> "Pending":
        """Begin to encode rows: on a GPU this returns while it works, elsewhere when it is done.

        Raises out-of-memory errors, and `VLMError` where the model cannot be compiled. Errors in
        the features are raised by `result`.
        """
        layout, padded = rows[0].layout, self._padded(rows)
        # Pinned memory and events belong to the thread's current device, which may be another.
        with torch.cuda.device(self.device if self.device.type == "cuda" else -1):
            try:
                batch = self._extractor.collate(padded)
                valid = self._extractor.valid(batch)[: len(rows)]

                def compute() -> Stored:
                    # Padded rows are dropped, and features converted, before they leave the device.
                    return pack(self._extractor.features(batch)[: len(rows)], self._storage_dtype)

                pending = Pending(compute, valid, self.device, self._check_finite)
            except RuntimeError as error:
                self._fitted[layout].discard(len(padded))
                if self._compiled:
                    raise _of_compiler(error) from None
                raise
        self._fitted[layout].add(len(padded))
        return pending

    def _padded(self, rows: Sequence[PreparedRow]) -> Sequence[PreparedRow]:
        """For a compiled model, the rows padded to a batch size that it has had before.

        So the last batch of a shape is not compiled again.
        """
        layout = rows[0].layout
        if not self._compiled or any(row.layout != layout for row in rows):
            return rows
        full = min((size for size in self._fitted[layout] if size >= len(rows)), default=len(rows))
        return [*rows, *[rows[-1]] * (full - len(rows))]

    def _check_finite(self, features: Stored) -> None:
        numbers = scales(features)
        least, most = torch.aminmax(numbers)  # one pass; both are NaN if any value is
        if not math.isfinite(least) or not math.isfinite(most):
            bad = ~torch.isfinite(numbers).all(dim=-1)
            row, slot = (int(index) for index in bad.nonzero()[0])
            raise NumericsError(
                f"row {row} of the batch, slot {self._spec.slots[slot].document()}: expected "
                f"finite features, found NaN or infinity ({int(bad.sum())} such slots of "
                f"{bad.numel()}). Computed as {self._spec.document['compute_dtype']}, stored as "
                f"{self._spec.document['storage_dtype']}: try bfloat16 or float32 for vlm.dtype "
                "and extract.dtype."
            )


class Pending:
    """Features that are being computed or copied to the CPU.

    The device's own clock, if it has one, measures the model's time, so that the host does not
    wait.
    """

    def __init__(
        self,
        compute: Callable[[], Stored],
        valid: Bool[Tensor, "batch slot"],
        device: torch.device,
        check: Callable[[Stored], None],
    ) -> None:
        """Begin to `compute` features on `device` and to copy them to the CPU."""
        self._valid, self._check = valid, check
        began, begun = time.perf_counter(), _event(device)
        features = compute()
        self._computed, self._took = (begun, _event(device)), time.perf_counter() - began
        self._features = features
        if device.type == "cuda":
            self._features = torch.empty(features.shape, dtype=features.dtype, pin_memory=True)
            self._features.copy_(features, non_blocking=True)
        self._copied = _event(device)

    def result(self) -> tuple[Stored, Bool[Tensor, "batch slot"]]:
        """Wait for the result of `FrozenVLM.encode`; raises like it."""
        if self._copied:
            self._copied.synchronize()
        self._check(self._features)
        return self._features, self._valid

    @property
    def done(self) -> bool:
        """Whether the `result` is ready; does not wait."""
        return self._copied is None or self._copied.query()

    @property
    def model_s(self) -> float:
        """Seconds that the model worked; waits for the `result`."""
        begun, done = self._computed
        if begun is None or done is None or self._copied is None:
            return self._took
        self._copied.synchronize()
        return begun.elapsed_time(done) / 1000


def _event(device: torch.device) -> torch.cuda.Event | None:
    """An event at this point of the device's work; None on the CPU, which does not run ahead."""
    if device.type != "cuda":
        return None
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event


def _of_compiler(error: RuntimeError) -> RuntimeError | VLMError:
    """torch.compile's error as an error for users; another error unchanged."""
    from torch._dynamo.exc import BackendCompilerFailed, TorchDynamoException  # takes a second

    if not isinstance(error, TorchDynamoException):
        return error
    if isinstance(error, BackendCompilerFailed) and isinstance(
        error.inner_exception, torch.OutOfMemoryError
    ):
        return torch.OutOfMemoryError(str(error.inner_exception))
    return VLMError(
        f"the model cannot be compiled here: {str(error).splitlines()[0]}. torch.compile needs a "
        "working C++ compiler (g++), and on a GPU a C compiler for Triton (gcc). Install one, or "
        "set extract.compile to false."
    )

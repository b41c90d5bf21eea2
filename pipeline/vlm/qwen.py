"""The frozen Qwen2.5-VL: load, adapt, encode."""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.base.config import VLMParams
from pipeline.base.errors import NumericsError, VLMError
from pipeline.base.machine import resolve_device
from pipeline.vlm.extractor import Extractor, layers_needed
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.loading import environment, load_model
from pipeline.vlm.preparation import PreparedRow, TokenLayout
from pipeline.vlm.processor import PixelSettings


class FrozenVLM:
    """A loaded Qwen2.5-VL that turns prepared rows into pooled features, and never learns."""

    environment: dict[str, str]
    """Attention backend, library versions and device; recorded, but not part of the identity."""

    def __init__(
        self, model: Any, settings: PixelSettings, spec: FeatureSpec, compiled: bool = False
    ) -> None:
        """Wrap an inner `Qwen2_5_VLModel` that is already on its device."""
        self._model = model
        self._extractor = Extractor(model, settings, spec.slots, compiled)
        self._spec = spec
        self._storage_dtype = getattr(torch, spec.document["storage_dtype"])
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

    def encode(
        self, rows: Sequence[PreparedRow]
    ) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
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

                def compute() -> Float[Tensor, "batch slot dim"]:
                    # Padded rows are dropped, and features converted, before they leave the device.
                    return self._extractor.features(batch)[: len(rows)].to(self._storage_dtype)

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

    def _check_finite(self, features: Float[Tensor, "batch slot dim"]) -> None:
        least, most = torch.aminmax(features)  # one pass; both are NaN if any value is
        if not math.isfinite(least) or not math.isfinite(most):
            bad = ~torch.isfinite(features).all(dim=-1)
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
        compute: Callable[[], Float[Tensor, "batch slot dim"]],
        valid: Bool[Tensor, "batch slot"],
        device: torch.device,
        check: Callable[[Float[Tensor, "batch slot dim"]], None],
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

    def result(self) -> tuple[Float[Tensor, "batch slot dim"], Bool[Tensor, "batch slot"]]:
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

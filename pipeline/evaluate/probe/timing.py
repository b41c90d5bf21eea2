"""How long a pass of the model takes that stops after a layer, measured with the model itself."""

import time
from collections.abc import Sequence
from contextlib import closing

import torch

from pipeline.base.config import VLMParams
from pipeline.base.differences import describe, differences
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreMismatch
from pipeline.base.hardware import resolve_device
from pipeline.store import FeatureStore
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.loading import load_model
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import PixelSettings
from pipeline.vlm.qwen import Extractor, layers_needed
from pipeline.vlm.slots import Slot

_PASSES = 7
"""Timed passes of each layer, in turns, after one that warms up.

The fastest counts: other load on the machine makes a pass slower, never faster.
"""
_SAME = ("weights", "adapter", "processor", "prompt", "compute_dtype")
"""Entries of a feature spec in which the model must be that of the store."""


@torch.inference_mode()
def time_passes(
    store: FeatureStore, vlm: VLMParams, layers: Sequence[int], device: str
) -> dict[int, float]:
    """Seconds of a pass on one row that stops after each of these layers; -1: the vision tower.

    The row is the store's first golden one; its frames are prepared before. Raises `StoreMismatch`
    where the store has none or `vlm` is another model than its own, and `VLMError` where the model
    cannot be loaded.
    """
    if not store.golden:
        raise StoreMismatch(f"{store.path}: has no golden row, whose frames could be passed")
    views, target = store.spec["views"], resolve_device(device)
    with closing(ContentDigests.to_read(ledger_path(store.path))) as digests:
        spec = feature_spec(vlm, "float32", views, digests.of, digests.text)
    held, given = ({n: document.get(n) for n in _SAME} for document in (store.spec, spec.document))
    if lines := describe(differences(held, given)):
        raise StoreMismatch(f"vlm is not the model of {store.path}: {lines[0]}")
    row = Preparer(vlm, spec).prepare(store.golden[0].instruction, store.golden[0].frames)
    slots = {
        layer: Slot("vision", False, "image_mean") if layer < 0 else Slot(layer, False, "mean")
        for layer in layers
    }
    model = load_model(vlm, layers_needed(slots.values()), target)
    text = model.language_model
    every, settings = text.layers, PixelSettings.of(vlm)
    extractors = {layer: Extractor(model, settings, (slots[layer],)) for layer in layers}
    took: dict[int, list[float]] = {layer: [] for layer in layers}
    for _ in range(1 + _PASSES):
        for layer, extractor in extractors.items():
            text.layers = every[: layer + 1]
            begun = time.perf_counter()
            extractor.extract([row])[0].cpu()  # waits for the device
            took[layer].append(time.perf_counter() - begun)
    return {layer: min(passes[1:]) for layer, passes in took.items()}

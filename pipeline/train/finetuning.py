"""Tuning the vision-language model end to end, with the policy that `train_head` describes.

`ModelFeatureSource` puts the model before the policy in the one training loop.
"""

from collections.abc import Generator, Iterable
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path

import torch

from pipeline.base.config import PCA, FinetuneParams, Params, TrainHeadParams, setting
from pipeline.base.digests import file_digest
from pipeline.base.errors import ConfigError
from pipeline.base.files import read_document, write_with_digest
from pipeline.base.printed_commands import command
from pipeline.base.provenance import (
    GoldenRow,
    TunedOn,
    join_tuned_on,
    tuned_on_of_store,
    write_tuned_on,
)
from pipeline.policy.checkpoint import DOCUMENT, PolicyDocument
from pipeline.policy.live_policy import LivePolicy
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, FeatureSource, Windows
from pipeline.train.finetuning_rows import (
    LiveFeed,
    LiveRows,
    check_recordings,
    check_spec,
    find_recordings,
    known_digests,
)
from pipeline.vlm.feature_spec import FeatureSpec, dtype_of, feature_spec
from pipeline.vlm.live import LiveVLM
from pipeline.vlm.preparation import Preparer

ADAPTER, CHECKPOINT = "adapter", "checkpoint"
_FREE_TUNING = {"gradient_checkpointing"}
"""Keys of the tuning that decide no number."""


class ModelFeatureSource(FeatureSource):
    """Features from a model that learns, on the recordings of a store."""

    def __init__(self, store: FeatureStore, params: Params, device: torch.device) -> None:
        """`attach` loads the model.

        Raises `StoreMismatch` where `vlm` does not give the store's features, or a recording is
        missing or not what it was at extraction.
        """
        super().__init__(store)
        recordings = find_recordings(store, params)
        with known_digests(store) as digests:
            self._spec = check_spec(store, params, digests)
            check_recordings(store, recordings, digests)
        self._vlm, self._finetune = params.vlm, params.finetune
        self._device = device
        self._rows = LiveRows(store, recordings, Preparer(params.vlm, self._spec))
        self._base_digest = lru_cache(file_digest)
        tuning = params.finetune.tuning
        self.eval_ticks = params.finetune.eval_ticks
        self.identity = {
            "spec": self._spec.digest,
            "tuning": tuning.model_dump(mode="json", exclude=_FREE_TUNING),
            "lr": params.finetune.lr,
            "eval_ticks": self.eval_ticks,
        }

    @property
    def golden(self) -> tuple[GoldenRow, ...]:
        """No rows: the store's golden rows have features of the model before it learned.

        A head that is trained on the tuned model's own store carries that store's rows.
        """
        return ()

    def attach(self, policy: Policy) -> Trainable:
        """The policy with the model in front."""
        load = partial(LiveVLM.load, self._vlm, self._spec, self._finetune.tuning)
        live = LivePolicy(policy, load, tuned=True)
        live.vlm = load(str(self._device))
        live.vlm.check_shape(policy.shape.slots, policy.shape.feature_dim)
        return live

    def policy_of(self, module: Trainable) -> Policy:
        """The policy behind the model."""
        assert isinstance(module, LivePolicy)
        return module.policy

    def parameter_lr(self, name: str) -> float | None:
        """`finetune.lr` for parameters of the model."""
        return self._finetune.lr if name.startswith("vlm.") else None

    def feed(
        self, plan: Iterable[BatchIndices], windows: Windows, device: torch.device
    ) -> LiveFeed:
        """Batches of the store with the rows of their ticks, decoded ahead of time."""
        threads = self._finetune.decode_threads
        return LiveFeed(self.store, self._rows, plan, windows, device, threads)

    def save(self, folder: Path, module: Trainable) -> None:
        """Write the tuned weights, the episodes they learned from, and the new feature spec.

        With that spec in `policy.json`, the policy fits a store that was extracted with this
        adapter or checkpoint, and not the store whose ticks it was trained on. Raises
        `DiskFull`.
        """
        assert isinstance(module, LivePolicy)
        assert module.vlm is not None
        learned = folder / learned_name(self._finetune)
        module.vlm.save(learned)
        path = folder / DOCUMENT
        document, content = read_document(path, PolicyDocument)
        before = tuned_on_of_store(self.store.attrs, self.store.path)
        own = TunedOn.of_split(document.split)
        write_tuned_on(learned, join_tuned_on([before, own]) or own)
        write_with_digest(path, content | {"feature_spec": self._tuned_spec(folder).attrs()})

    def summary(self) -> list[str]:
        """Lines for the user: what learns, and from which frames."""
        tuning = self._finetune.tuning
        rank = f" of rank {tuning.lora_r}" if tuning.method == "lora" else ""
        lines = [
            f"tuning: {tuning.method}{rank} on the {' and '.join(tuning.towers)} tower, peak "
            f"learning rate {self._finetune.lr:g}; {len(self.store.array('vl/time'))} VL rows of "
            f"{len(self.store.episodes)} recordings"
        ]
        if self.store.variants > 1:
            lines.append(
                f"tuning: the store's {self.store.variants - 1} augmented variant(s) of each row "
                "are not used, the model sees the plain frames"
            )
        return lines

    def _tuned_spec(self, folder: Path) -> FeatureSpec:
        """The feature spec that `extract` will give the model in this checkpoint."""
        learned = str(folder / learned_name(self._finetune))
        changes = {"adapter": learned}
        if self._finetune.tuning.method == "full":
            changes = {"checkpoint": learned, "revision": None, "adapter": None}
        vlm = self._vlm.model_copy(update=changes)
        dtype, basis = dtype_of(self._spec.document), self._spec.basis

        def digest(path: Path) -> str:
            # The base's files are read once; the tuned ones change with every checkpoint.
            return file_digest(path) if path.is_relative_to(folder) else self._base_digest(path)

        return feature_spec(vlm, dtype, self._spec.views, digest, basis=basis)


def head_params(params: Params) -> TrainHeadParams:
    """`train_head` with the values of `finetune` in place of its own.

    Raises `ConfigError` where nothing of the model would learn, the policy would not see it, or
    would see more than one row.
    """
    if params.finetune.tuning.method == "none":
        raise ConfigError(
            "finetune.tuning.method is none, so nothing of the vision-language model would learn. "
            "Set it to lora or full; a policy on the model as it is comes from the store alone: "
            f"{command('train_head')}"
        )
    if not params.train_head.features_enabled:
        raise ConfigError(
            "train_head.features_enabled is false, so the policy would not see the model that is "
            "tuned. Set it to true."
        )
    if params.train_head.feature_history > 1:
        raise ConfigError(
            f"train_head.feature_history {params.train_head.feature_history}: the model is tuned "
            "on one row a tick. Set it to 1 for stages.finetune."
        )
    kept = {"lr": params.train_head.lr, "keep_every": None}  # `finetune.lr` is the model's
    shared = TrainHeadParams.model_fields.keys() & FinetuneParams.model_fields.keys()
    changes = {name: getattr(params.finetune, name) for name in shared} | kept
    return params.train_head.model_copy(update=changes)


@contextmanager
def out_of_memory_named() -> Generator[None]:
    """Raise `ConfigError`, saying what takes less memory, where the GPU has too little."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise ConfigError(
            f"the GPU's memory does not hold a step of tuning: {error}. Raise "
            "finetune.grad_accumulation or lower finetune.batch_size, set "
            "finetune.tuning.gradient_checkpointing=true, tune with lora, or lower "
            "vlm.image_resize_height and vlm.image_resize_width."
        ) from None


def learned_name(finetune: FinetuneParams) -> str:
    """The folder of the tuned weights within a checkpoint's."""
    return ADAPTER if finetune.tuning.method == "lora" else CHECKPOINT


def next_steps(finetune: FinetuneParams, store: FeatureStore) -> list[str]:
    """Lines for the user: what to run with the tuned model."""
    learned = finetune.output / "best" / learned_name(finetune)
    tuned = store.path.with_name(f"{store.path.stem}_tuned.zarr")
    model = [setting("vlm.adapter", learned)]
    if finetune.tuning.method == "full":
        model = [setting("vlm.checkpoint", learned), "--set vlm.adapter=null"]
    dtype, basis = dtype_of(store.spec), list[str]()
    if isinstance(dtype, PCA):
        dtype = dtype.model_copy(update={"basis": store.path}).model_dump(mode="json")
        basis = [
            f"the model was tuned on the basis of {store.path}, so its store takes it; with basis: "
            "null one is fitted to the tuned features, which the tuned policy does not read"
        ]
    model.append(setting("extract.dtype", dtype))
    head, logs = Path("models", tuned.stem), Path("reports", f"{tuned.stem}_training")
    report = Path("reports", tuned.stem)
    places: dict[str, dict[str, Path]] = {
        "extract": {"store": tuned},
        "train_head": {"store": tuned, "output": head, "logs": logs},
        "evaluate": {"store": tuned, "checkpoint": head, "output": report},
    }
    lines = ["next, extract the tuned model's features, train a head on them and evaluate it:"]
    for stage, keys in places.items():
        settings = [setting(f"{stage}.{key}", place) for key, place in keys.items()]
        lines.append(f"  {command(stage, *(model if stage == 'extract' else ()), *settings)}")
    return lines + basis

"""Tune the vision-language model end to end from recordings, with the policy of train_head on top.

Ticks, streams, split and normalisation come from the store that extract wrote, frames from the
recordings of data.sources. Writes checkpoints with an adapter (or a whole model) to
finetune.output, so that extract can compute better features with it, and curves to finetune.logs.
While it runs, `dvc plots show <finetune.logs>/plots/metrics` draws them (train_head.loggers adds
TensorBoard and Weights & Biases).

  python -m stages.finetune                                        low-rank adapters
  python -m stages.finetune --set finetune.tuning.method=full      every weight

If a GPU has too little memory, raise finetune.grad_accumulation, lower finetune.batch_size, or set
finetune.tuning.gradient_checkpointing=true.

Works in `<finetune.output>.part` and renames it when finished. After a stop or a kill, the same
command continues from the last checkpoint. At its end it prints what to run next.
"""

from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("finetune", "train_head")
SHORTHANDS = short("finetune", "--lr", "--steps", "--batch", "--out")


def main(params: "Params") -> None:
    """Tune the model that `vlm` and `finetune` describe."""
    from pipeline.base.hardware import resolve_device
    from pipeline.store import FeatureStore
    from pipeline.train.finetuning import (
        ModelFeatureSource,
        head_params,
        next_steps,
        out_of_memory_named,
    )
    from pipeline.train.loop import train

    head = head_params(params)
    store = FeatureStore.open(head.store or params.extract.store)
    source = ModelFeatureSource(store, params, resolve_device(head.device))
    with out_of_memory_named():
        train(store, head, source, "finetune")
    print("\n".join(next_steps(params.finetune, store)))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

"""Tune the vision-language model end to end from recordings, with the policy of train_head on top.

Ticks, streams, split and normalisation come from the store that extract wrote, frames from the
recordings of data.sources. Writes checkpoints with an adapter (or a whole model) to
finetune.output, so that extract can compute better features with it, and curves to finetune.logs.
While it runs, `dvc plots show <finetune.logs>/plots/metrics` draws them (train_head.loggers adds
TensorBoard and Weights & Biases).

  python -m stages.finetune                                        low-rank adapters
  python -m stages.finetune --set finetune.tuning.method=full      every weight
  torchrun --nproc_per_node 2 -m stages.finetune                   on two GPUs

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
    from pipeline.store import FeatureStore, check_trailers
    from pipeline.train.finetuning import (
        ModelFeatureSource,
        head_params,
        next_steps,
        out_of_memory_named,
    )
    from pipeline.train.log import check_loggers
    from pipeline.train.loop import Trainer
    from pipeline.train.process_group import process_device, process_group
    from pipeline.train.run import open_run, run_lock
    from pipeline.train.split import split_by_episode
    from pipeline.train.training_data import refuse_tuned_episodes

    with process_group(params.train_head.device) as processes:
        head = head_params(params)
        processes.shared(lambda: check_loggers(head))
        store = FeatureStore.open(head.store or params.extract.store)
        with processes.holding(run_lock(head)), out_of_memory_named():
            source = ModelFeatureSource(store, params, process_device(head.device))
            opened = processes.shared(lambda: open_run(head, store, source.identity, "finetune"))
            processes.say(*opened.notes)
            if opened.status == "finished":
                processes.say("nothing to do", *next_steps(params.finetune, store))
                return
            if head.check_store:
                processes.shared(lambda: check_trailers(store.path))
            split = split_by_episode(store, head.split, head.horizon)
            processes.say(*refuse_tuned_episodes(store, split))
            trainer = Trainer(store, head, split, opened, source)
            processes.say(*trainer.summary(), *source.summary())
            trainer.fit()
        processes.say(f"best and last checkpoint: {opened.output}; curves: {head.logs}")
        processes.say(*next_steps(params.finetune, store))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

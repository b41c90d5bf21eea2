"""Train a policy head from the store alone: no image, no vision-language model.

Reads train_head.store (extract.store if null). Writes the best and the last checkpoint to
train_head.output and curves to train_head.logs; while it runs, `dvc plots show` draws them.
train_head.split says which groups of episodes choose the checkpoint (val) and which are kept for
stages.evaluate (test).

  python -m stages.train_head                                      what params.yaml says
  python -m stages.train_head --expert diffusion --steps 2000      or regression, flow_matching
  python -m stages.train_head --set 'train_head.loggers=[tensorboard]'        or wandb, or both
  torchrun --nproc_per_node 2 -m stages.train_head                 on two GPUs: the same curve

Set these first: train_head.max_steps, batch_size, lr, horizon (ticks of an action chunk),
fusion_strategy, mixture (weights of sources), device. train_head.feed says where batches are
gathered; it changes no result.

Works in `<output>.part` and renames it when finished. After a stop or a kill, the same command
continues from the last checkpoint. If the run is finished, it does nothing; with other params it
begins another run.

Next: python -m stages.evaluate
"""

from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("train_head",)
SHORTHANDS = short(
    "train_head", "--expert", "--lr", "--steps", "--batch", "--store", "--out", "--device"
)


def main(params: "Params") -> None:
    """Train the head that `train_head` describes."""
    from pipeline.train.run import finished_run

    finished = finished_run(params.train_head, params.train_head.store or params.extract.store)
    if finished is None:
        _train(params)
    else:
        print(*finished.notes, "nothing to do", sep="\n")


def _train(params: "Params") -> None:
    # These import torch, which takes over a second.
    from pipeline.store import FeatureStore, check_trailers
    from pipeline.train.log import check_loggers
    from pipeline.train.loop import Trainer
    from pipeline.train.process_group import process_group
    from pipeline.train.run import open_run, run_lock
    from pipeline.train.split import split_by_episode
    from pipeline.train.training_data import refuse_tuned_episodes

    head = params.train_head
    with process_group(head.device) as processes:
        processes.shared(lambda: check_loggers(head))
        store = FeatureStore.open(head.store or params.extract.store)
        with processes.holding(run_lock(head)):
            opened = processes.shared(lambda: open_run(head, store))
            processes.say(*opened.notes)
            if opened.status == "finished":
                processes.say("nothing to do")
                return
            if head.check_store:
                processes.shared(lambda: check_trailers(store.path))
            split = split_by_episode(store, head.split, head.horizon)
            processes.say(*refuse_tuned_episodes(store, split))
            trainer = Trainer(store, head, split, opened)
            processes.say(*trainer.summary())
            trainer.fit()
        processes.say(f"best and last checkpoint: {opened.output}; curves: {head.logs}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

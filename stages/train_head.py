"""Train a policy head from the store alone: no image, no vision-language model.

Reads train_head.store (extract.store if null). Writes the best and the last checkpoint to
train_head.output and curves to train_head.logs; while it runs, `dvc plots show` draws them.
train_head.split says which groups of episodes choose the checkpoint (val) and which are kept for
stages.evaluate (test).

  python -m stages.train_head                                      what params.yaml says
  python -m stages.train_head --expert diffusion --steps 2000      or regression, flow_matching
  python -m stages.train_head --set 'train_head.loggers=[tensorboard]'        or wandb, or both

Set these first: train_head.max_steps, batch_size, lr, horizon (ticks of an action chunk),
fusion_strategy, mixture (weights of sources), device.

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
    if finished is not None:
        print(*finished.notes, "nothing to do", sep="\n")
        return
    # These import torch, which takes over a second.
    from pipeline.store import FeatureStore
    from pipeline.train.loop import train

    store = FeatureStore.open(params.train_head.store or params.extract.store)
    train(store, params.train_head)


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

"""Train a policy head from the store alone: no image, no vision-language model.

Works in `<train_head.output>.part` and renames it when finished. Stopped or killed, the same
command continues from the last checkpoint; finished, it does nothing.
"""

from pipeline.config import Params
from pipeline.sampling import split_by_episode
from pipeline.store import FeatureStore, build_lock
from pipeline.training import Trainer, open_run
from stages.command import run


def main(params: Params) -> None:
    """Train the head that `train_head` describes."""
    head = params.train_head
    store = FeatureStore.open(head.store or params.extract.store)
    with build_lock(head.output):
        opened = open_run(head, store)
        for note in opened.notes:
            print(note)
        if opened.status == "finished":
            print("nothing to do")
            return
        split = split_by_episode(store, head.val_fraction, head.horizon)
        trainer = Trainer(store, head, split, opened)
        print("\n".join(trainer.summary()), flush=True)
        trainer.fit()
    print(f"best and last checkpoint: {opened.output}; curves: {head.logs}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main))

"""Train a policy head from the store alone: no image, no vision-language model.

Works in `<train_head.output>.part` and renames it when finished. Stopped or killed, the same
command continues from the last checkpoint; finished, it does nothing.

An archive of a store serves as well: it is restored once, to `train_head.scratch`. Batches are
gathered from the mapped store or on the device, as `train_head.feed` says; no number depends on it.

On several GPUs or machines, each process takes its share of every batch:
    torchrun --nproc_per_node 2 -m stages.train_head
"""

from pipeline.batches import open_store
from pipeline.config import Params
from pipeline.sampling import split_by_episode
from pipeline.store import build_lock, check_trailers
from pipeline.training import Trainer, open_run, process_group
from stages.command import run


def main(params: Params) -> None:
    """Train the head that `train_head` describes."""
    head = params.train_head
    with process_group(head.device) as world:
        path = head.store or params.extract.store
        store = open_store(path, head.feed, head.scratch, world.say)
        with world.holding(build_lock(head.output)):
            opened = world.shared(lambda: open_run(head, store))
            world.say(*opened.notes)
            if opened.status == "finished":
                world.say("nothing to do")
                return
            if head.check_store:
                world.shared(lambda: check_trailers(store.path))
            split = split_by_episode(store, head.val_fraction, head.horizon)
            trainer = Trainer(store, head, split, opened)
            world.say(*trainer.summary())
            trainer.fit()
        world.say(f"best and last checkpoint: {opened.output}; curves: {head.logs}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=("train_head",)))

"""Judge a trained policy on the episodes it has not seen, beside three baselines.

Writes metrics.json, tables (CSV) and pictures (PNG) into `evaluate.output`.
"""

from pipeline.batches import Windows
from pipeline.checkpoint import find_policy, load_policy
from pipeline.config import Params
from pipeline.device import resolve_device
from pipeline.evaluation import check_store, held_out_ticks, judge, table, write_tables
from pipeline.plots import write_plots
from pipeline.store import FeatureStore
from stages.command import run


def main(params: Params) -> None:
    """Judge the checkpoint that `evaluate` names."""
    wanted = params.evaluate
    device = resolve_device(wanted.device)
    folder = find_policy(wanted.checkpoint)
    checkpoint = load_policy(folder)
    store = FeatureStore.open(wanted.store or params.train_head.store or params.extract.store)
    check_store(checkpoint, store)
    ticks = held_out_ticks(store, checkpoint.held_out_ticks, checkpoint.held_out_content)
    print(
        f"{folder} (step {checkpoint.step}) on {len(ticks)} held-out ticks of "
        f"{len(checkpoint.held_out_ticks)} episode(s) in {store.path}, device {device}"
    )
    comparison, predictions = judge(
        checkpoint.policy(device),
        store,
        ticks,
        Windows.of(checkpoint.params),
        wanted.batch_size,
        checkpoint.normalization,
        progress=True,
    )
    wanted.output.mkdir(parents=True, exist_ok=True)
    files = write_tables(wanted.output, comparison, predictions, store)
    files += write_plots(wanted.output, comparison, predictions, store)
    print(table(comparison))
    print(f"{wanted.output}: {', '.join(file.name for file in files)}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main))

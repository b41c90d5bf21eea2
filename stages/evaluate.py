"""Judge a trained policy on the episodes it has not seen, beside three baselines.

Writes metrics.json, tables (CSV) and a page with its pictures (report.html, PNG) into
`evaluate.output`, and judged.json, which says what was judged on what. With `evaluate.modalities`,
judges again with each stream spoilt. The page shows the frames of the best and the worst episode
where their recordings still lie below `data.root`.
An archive of a store serves as well: it is restored once, to `train_head.scratch`.
"""

from pipeline.batches import Windows, open_store
from pipeline.checkpoint import find_policy, load_policy
from pipeline.config import Params
from pipeline.device import resolve_device
from pipeline.durable import write_document
from pipeline.evaluation import (
    JUDGED,
    Judgement,
    check_store,
    held_out_ticks,
    judge,
    judge_modalities,
    judged_document,
    modality_table,
    read_curves,
    table,
    write_tables,
)
from pipeline.report import write_report
from pipeline.report.evaluation import evaluation_report
from pipeline.store import check_trailers
from stages.command import run


def main(params: Params) -> None:
    """Judge the checkpoint that `evaluate` names."""
    wanted = params.evaluate
    device = resolve_device(wanted.device)
    folder = find_policy(wanted.checkpoint)
    checkpoint = load_policy(folder)
    path = wanted.store or params.train_head.store or params.extract.store
    store = open_store(path, "auto", params.train_head.scratch, print)
    check_store(checkpoint, store)
    if params.train_head.check_store:
        check_trailers(store.path)
    ticks = held_out_ticks(store, checkpoint.held_out_ticks, checkpoint.held_out_content)
    policy = checkpoint.policy(device)
    judged = judged_document(checkpoint, policy, store, wanted.samples, wanted.batch_size)
    print(
        f"{folder} (step {checkpoint.step}) on {len(ticks)} held-out ticks of "
        f"{len(checkpoint.held_out_ticks)} episode(s) in {store.path}, device {device}, "
        f"{judged['policy']['samples']} chunk(s) a tick",
        flush=True,
    )
    comparison, predictions = judge(
        policy,
        store,
        ticks,
        Windows.of(checkpoint.params),
        wanted.batch_size,
        checkpoint.normalization,
        progress=True,
        samples=wanted.samples,
    )
    study = None
    if wanted.modalities:
        study = judge_modalities(
            checkpoint, policy, store, ticks, wanted.batch_size, wanted.samples, progress=True
        )
    wanted.output.mkdir(parents=True, exist_ok=True)
    files = write_tables(wanted.output, comparison, predictions, store, study)
    write_document(wanted.output / JUDGED, judged)
    found = Judgement(
        name=str(wanted.checkpoint),
        checkpoint=checkpoint,
        store=store,
        comparison=comparison,
        predictions=predictions,
        study=study,
        judged=judged,
        curves=read_curves(checkpoint.params.logs),
        recordings=params.data.root,
    )
    files += [wanted.output / JUDGED, *write_report(wanted.output, evaluation_report(found))]
    print(table(comparison))
    if study is not None:
        print(f"\n{modality_table(study)}")
    elif wanted.modalities:
        print("streams were not spoilt: no held-out tick lies 200 ms into its episode")
    print(f"{wanted.output}: {', '.join(file.name for file in files)}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=("evaluate",)))

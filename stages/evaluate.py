"""Evaluate a trained policy on its test episodes, and compare it with simple rules.

Reads what stages.train_head wrote to train_head.output, or evaluate.checkpoint if it is set. Writes
metrics.json, headline.json (what decides between policies, for `dvc metrics show`), tables (CSV)
and a page with its pictures (report.html, PNG) into `evaluate.output`, and judged.json, which says
what was evaluated on what. With `evaluate.modalities` it evaluates again with each stream ablated.
"""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params
    from pipeline.evaluate.evaluation import Evaluation
    from pipeline.policy.checkpoint import PolicyCheckpoint
    from pipeline.store import FeatureStore

SECTIONS = ("evaluate",)
SHORTHANDS = short("evaluate", "--checkpoint", "--store", "--out", "--device")


def main(params: "Params") -> None:
    """Evaluate the checkpoint that `evaluate` names, else what `train_head` wrote."""
    from pipeline.base.files import REPORT, refuse_foreign
    from pipeline.base.hardware import resolve_device
    from pipeline.evaluate.evaluation import evaluate_checkpoint
    from pipeline.evaluate.tables import ablation_text, error_text
    from pipeline.policy.checkpoint import find_policy, load_policy

    refuse_foreign(params.evaluate.output, REPORT)
    folder = params.evaluate.checkpoint or params.train_head.output
    checkpoint = load_policy(find_policy(folder))
    store = _store_for(checkpoint, params)
    device, say = resolve_device(params.evaluate.device), partial(print, flush=True)
    evaluation = evaluate_checkpoint(folder, checkpoint, store, params.evaluate, device, say)
    files = _write(params.evaluate.output, evaluation, _rollouts_page(params))
    print(error_text(evaluation.comparison, evaluation.energy))
    if evaluation.study is not None:
        print(f"\n{ablation_text(evaluation.study)}")
    elif params.evaluate.modalities:
        print("streams were not ablated: no test tick lies 200 ms into its episode")
    print(f"{params.evaluate.output}: {', '.join(file.name for file in files)}")


def _store_for(checkpoint: "PolicyCheckpoint", params: "Params") -> "FeatureStore":
    """The store that is named, else the one trained from, after a check that the policy fits it."""
    from pipeline.store import FeatureStore, check_trailers
    from pipeline.train.training_data import check_store

    path = params.evaluate.store or params.train_head.store or params.extract.store
    store = FeatureStore.open(path)
    check_store(checkpoint, store)
    if params.evaluate.check_store:
        check_trailers(store.path)
    return store


def _rollouts_page(params: "Params") -> str:
    """The path from this page to that of stages.rollout; empty unless it shows the same policy.

    It follows from the params alone, because dvc repro runs stages.rollout after this stage.
    """
    from pipeline.look.page.writing import PAGE

    judged, rolled_out = (
        section.checkpoint or params.train_head.output
        for section in (params.evaluate, params.rollout)
    )
    page = os.path.relpath(params.rollout.output / PAGE, params.evaluate.output)
    return page if judged == rolled_out and params.rollout.environment else ""


def _write(folder: Path, evaluation: "Evaluation", rollouts: str) -> list[Path]:
    """Write the tables, the page with its pictures and judged.json; returns their paths."""
    from pipeline.base.files import REPORT, claim, write_document
    from pipeline.evaluate.evaluation import JUDGED
    from pipeline.evaluate.tables import write_tables
    from pipeline.look.evaluation import evaluation_report
    from pipeline.look.page.writing import write_report

    claim(folder, REPORT)
    files = write_tables(folder, evaluation)
    write_document(folder / JUDGED, evaluation.judged)
    report = evaluation_report(evaluation, rollouts)
    return [*files, folder / JUDGED, *write_report(folder, report)]


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

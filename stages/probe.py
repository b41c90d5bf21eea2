"""Rank the slots of a store by how well a ridge regression reads the action chunk from them.

Reads probe.store (extract.store if null), and its checksums first (probe.check_store). It scores
each slot, and each choice of layer, norm and pooling as a whole: alone, and together with past
actions, state and sensor, cross-validated by recording. Prints the ranking with 95 % intervals and
the line for params.yaml that the results support. Writes metrics.json, slots.csv, groups.csv
and a page (report.html) into probe.output.

  python -m stages.probe                             as params.yaml stands
  python -m stages.probe --set probe.max_ticks=2000  that many ticks, evenly spread: a first look

  python -m stages.probe --set 'probe.codecs=[int8, {pca: 128, then: int8}]'
                                                     and what fewer bytes would lose
  python -m stages.probe --set probe.time=true       and how long a pass takes up to each layer

You can also --set probe.output (where the files go), probe.folds (groups of recordings, each
predicted from the others), probe.repeats (how often these are dealt) and probe.horizon (ticks of
the predicted action chunk).

Next: set vlm.pooling to that line, then python -m stages.extract
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params
    from pipeline.evaluate.probe.study import ProbeStudy
    from pipeline.store import FeatureStore

SECTIONS = ("probe",)
SHORTHANDS = short("probe", "--store", "--out")


def main(params: "Params") -> None:
    """Probe the store that `probe` names."""
    from pipeline.base.files import REPORT, claim, refuse_foreign
    from pipeline.evaluate.probe.study import probe
    from pipeline.evaluate.probe.tables import advice, proofs, table, write_tables
    from pipeline.look.page.writing import write_report
    from pipeline.look.probe import probe_report
    from pipeline.store import FeatureStore, check_trailers
    from pipeline.store.proofs import write_proofs

    wanted = params.probe
    refuse_foreign(wanted.output, REPORT)
    store = FeatureStore.open(wanted.store or params.extract.store)
    slots, dim = store.feature_shape
    print(f"{store.path}: {slots} slots of {dim} channels at {store.ticks} ticks", flush=True)
    if wanted.check_store:
        check_trailers(store.path)
    study = probe(store, wanted)
    if wanted.time:
        study = _timed(study, store, params)
    claim(wanted.output, REPORT)
    if study.codecs:
        kept = write_proofs(store.path, store.spec, proofs(study, store))
        print(f"{kept}: what these types lose, for extractions of the same features beside it")
    files = [
        *write_tables(wanted.output, study),
        *write_report(wanted.output, probe_report(study, store.path.name)),
    ]
    print(table(study))
    print(advice(study))
    print(f"{wanted.output}: {', '.join(file.name for file in files)}")


def _timed(study: "ProbeStudy", store: "FeatureStore", params: "Params") -> "ProbeStudy":
    """The study with the seconds of a pass; without, and a line that says why, if it has no
    model."""
    from pipeline.base.errors import StoreMismatch, VLMError
    from pipeline.evaluate.probe.study import depth
    from pipeline.evaluate.probe.timing import time_passes

    layers = sorted({depth(result.name) for result in (*study.groups, *study.slots)})
    try:
        seconds = time_passes(store, params.vlm, layers, params.extract.device)
    except (StoreMismatch, VLMError) as error:
        print(f"not timed: {error}")
        return study
    return replace(study, seconds=seconds)


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

"""Which stored feature carries the action: slots ranked by what a linear reader finds in them.

`folds` holds recordings out, `inputs` is what is read at a tick, `ridge` the regression, `study`
does it for all slots and says which are better, and `tables` tells it.
"""

from pipeline.evaluate.probe.folds import ProbeFolds, fold_by_recording
from pipeline.evaluate.probe.inputs import SlotName
from pipeline.evaluate.probe.ridge import ProbeScore
from pipeline.evaluate.probe.study import ProbeResult, ProbeStudy, probe, ranked, recommend
from pipeline.evaluate.probe.tables import advice, metrics, table, write_tables

__all__ = [
    "ProbeFolds",
    "ProbeResult",
    "ProbeScore",
    "ProbeStudy",
    "SlotName",
    "advice",
    "fold_by_recording",
    "metrics",
    "probe",
    "ranked",
    "recommend",
    "table",
    "write_tables",
]

"""Which stored feature carries the action: slots ranked by what a linear reader finds in them.

`folds` holds recordings out, `summaries` is what state and sensor know anyway, `readers` says what
is read of a row, `accumulation` adds it up to `moments` in one pass, `ridge` is the regression from
such sums, `run` does it for all slots, `ranking` says which are better and `tables` tells it.
"""

from pipeline.evaluate.probe.folds import Folds, fold_by_recording
from pipeline.evaluate.probe.ranking import Recommendation, ranked, recommend
from pipeline.evaluate.probe.readers import SlotName
from pipeline.evaluate.probe.ridge import Score
from pipeline.evaluate.probe.run import Finding, Study, probe
from pipeline.evaluate.probe.tables import advice, metrics, table, write_tables

__all__ = [
    "Finding",
    "Folds",
    "Recommendation",
    "Score",
    "SlotName",
    "Study",
    "advice",
    "fold_by_recording",
    "metrics",
    "probe",
    "ranked",
    "recommend",
    "table",
    "write_tables",
]

"""Which stored feature carries the action: slots ranked by what a linear reader finds in them.

`folds` holds recordings out, `summaries` is what state and sensor know anyway, `readers` says what
is read of a row, `accumulation` adds it up to `moments` in one pass, `ridge` is the regression from
such sums, `run` does it for all slots, `ranking` says which are better and `tables` tells it.
"""

from pipeline.probing.folds import Folds, fold_by_recording
from pipeline.probing.ranking import Recommendation, ranked, recommend
from pipeline.probing.readers import SlotName
from pipeline.probing.ridge import Score
from pipeline.probing.run import Finding, Study, probe
from pipeline.probing.tables import advice, metrics, table, write_tables

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

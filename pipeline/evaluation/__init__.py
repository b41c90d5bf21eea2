"""A policy judged on recordings it has not seen, beside baselines that see nothing."""

from pipeline.evaluation.cells import write_rows
from pipeline.evaluation.curves import Curve, Curves, read_curves
from pipeline.evaluation.experiment_tables import (
    experiment_errors,
    experiment_rows,
    experiments_table,
)
from pipeline.evaluation.experiments import Experiment, read_experiments
from pipeline.evaluation.held_out import (
    check_store,
    held_out_contents,
    held_out_ranges,
    held_out_ticks,
    judge,
)
from pipeline.evaluation.judged import JUDGED, Judgement, judged_document, judgement
from pipeline.evaluation.modalities import ModalityStudy, Spoilt, judge_modalities
from pipeline.evaluation.modality_tables import FOOTNOTE as MODALITY_FOOTNOTE
from pipeline.evaluation.modality_tables import (
    best_baseline,
    judged_on,
    modality_errors,
    modality_table,
)
from pipeline.evaluation.names import with_unit
from pipeline.evaluation.predictions import (
    BASELINES,
    METHODS,
    FeedMaker,
    Predictions,
    baselines,
    predict,
)
from pipeline.evaluation.scores import Comparison, Group, Scores, compare
from pipeline.evaluation.tables import (
    FOOTNOTE,
    HEADINGS,
    error_rows,
    metrics,
    still_dimensions,
    table,
    write_tables,
)

__all__ = [
    "BASELINES",
    "FOOTNOTE",
    "HEADINGS",
    "JUDGED",
    "METHODS",
    "MODALITY_FOOTNOTE",
    "Comparison",
    "Curve",
    "Curves",
    "Experiment",
    "FeedMaker",
    "Group",
    "Judgement",
    "ModalityStudy",
    "Predictions",
    "Scores",
    "Spoilt",
    "baselines",
    "best_baseline",
    "check_store",
    "compare",
    "error_rows",
    "experiment_errors",
    "experiment_rows",
    "experiments_table",
    "held_out_contents",
    "held_out_ranges",
    "held_out_ticks",
    "judge",
    "judge_modalities",
    "judged_document",
    "judged_on",
    "judgement",
    "metrics",
    "modality_errors",
    "modality_table",
    "predict",
    "read_curves",
    "read_experiments",
    "still_dimensions",
    "table",
    "with_unit",
    "write_rows",
    "write_tables",
]

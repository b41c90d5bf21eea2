"""A policy judged on recordings it has not seen, beside baselines that see nothing."""

from pipeline.evaluation.held_out import (
    check_store,
    held_out_contents,
    held_out_ranges,
    held_out_ticks,
    judge,
)
from pipeline.evaluation.names import episode_name, place, with_unit
from pipeline.evaluation.predictions import BASELINES, METHODS, Predictions, baselines, predict
from pipeline.evaluation.scores import Comparison, Group, Scores, compare
from pipeline.evaluation.tables import metrics, table, write_tables

__all__ = [
    "BASELINES",
    "METHODS",
    "Comparison",
    "Group",
    "Predictions",
    "Scores",
    "baselines",
    "check_store",
    "compare",
    "episode_name",
    "held_out_contents",
    "held_out_ranges",
    "held_out_ticks",
    "judge",
    "metrics",
    "place",
    "predict",
    "table",
    "with_unit",
    "write_tables",
]

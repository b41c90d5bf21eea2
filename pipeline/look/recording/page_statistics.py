"""Per-channel statistics -> a table in which a thousand like channels are one row."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from pipeline.base.channels import PROFILE_CHANNELS, unnumbered
from pipeline.look.page.blocks import Table
from pipeline.look.recording.facts import ChannelStatistics

HEADS = (
    "stream", "channel", "unit", "count", "min", "1 %", "median", "99 %", "max", "mean", "std",
)  # fmt: skip


def statistics_table(statistics: Sequence[ChannelStatistics]) -> Table:
    """A row a channel; channels that differ by a number in their names are one from 24 on."""
    rows: list[tuple[object, ...]] = []
    many = False
    for _, like in groupby(statistics, lambda one: (one.stream, unnumbered(one.name), one.unit)):
        group = list(like)
        if len(group) < PROFILE_CHANNELS:
            rows += [_row(one) for one in group]
        else:
            rows.append(_joint_row(group))
            many = True
    said = "Over the whole episode, before any normalisation."
    if many:
        said += (
            " A row of many channels shows the lowest minimum, the highest maximum, and of the rest"
            " the median over the channels."
        )
    return Table(HEADS, rows, said)


def _row(one: ChannelStatistics) -> tuple[object, ...]:
    values = (one.minimum, one.low, one.median, one.high, one.maximum, one.mean, one.std)
    return (one.stream, one.name, one.unit, one.count, *values)


def _joint_row(group: Sequence[ChannelStatistics]) -> tuple[object, ...]:
    first, last = group[0], group[-1]

    def middle(name: str) -> float:
        return float(np.median([getattr(one, name) for one in group]))

    return (
        first.stream,
        f"{first.name} … {last.name} ({len(group):,} channels)",
        first.unit,
        first.count,
        min(one.minimum for one in group),
        *(middle(name) for name in ("low", "median", "high")),
        max(one.maximum for one in group),
        *(middle(name) for name in ("mean", "std")),
    )

"""A store -> its page: what is in it, what looks wrong, and where its features lie."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.format import duration, size
from pipeline.look.page.blocks import (
    Block,
    Document,
    Notices,
    Picture,
    Report,
    Section,
    Table,
    Text,
)
from pipeline.look.recording.channels import ChannelStatistics, statistics_table
from pipeline.look.recording.issues import notices
from pipeline.look.store import draw as pictures
from pipeline.look.store.facts import EpisodeCoverage, StoreView
from pipeline.look.store.page_features import duplicates, features

ROWS = 100
"""Episodes in the table of all; of more, the first."""
_CHANNELS = 16
"""Of a stream, that its description names."""


def store_report(view: StoreView) -> Report:
    """The page of a store, by what `inspect_store` found; the same store gives the same page."""
    rate = "as recorded" if view.action_hz is None else f"at {view.action_hz:g} Hz"
    reuse = view.vlm_reuse_count
    return Report(
        title=f"Store: {view.path.name}",
        summary=(
            f"Ticks {rate}, features of the model (a VL row) at "
            f"{'each of them' if reuse == 1 else f'one in {reuse}'}; feature spec "
            f"`{view.spec['digest']}`. Times count from the first tick of their episode."
        ),
        tiles=_tiles(view),
        sections=(
            Section("What looks wrong", [_notices(view), _checked(view)]),
            Section("Coverage", _coverage(view)),
            Section("Age of the features", _ages(view)),
            Section("Size", _sizes(view)),
            Section("Features", features(view)),
            Section("Near-duplicates", duplicates(view)),
            Section("Channels", _channels(view)),
            Section("What it was made of", _documents(view)),
        ),
    )


def _tiles(view: StoreView) -> list[tuple[str, str]]:
    return [
        ("episodes", f"{len(view.episodes):,}"),
        ("length", duration(view.seconds)),
        ("ticks", f"{view.ticks:,}"),
        ("VL rows", f"{view.sampled.total:,}"),
        ("on the disk", size(view.disk_bytes)),
        ("findings", f"{len(view.flaws):,}"),
    ]


def _notices(view: StoreView) -> Notices:
    return Notices(
        notices(view.flaws, {}),
        "Nothing: clocks ascend, every stream is where others of its kind are, channels move, "
        "features follow the scene, and no recording is there twice.",
    )


def _checked(view: StoreView) -> Text:
    looked, total = view.sampled.looked_at, view.sampled.total
    rows = f"all {total:,}" if looked == total else f"{looked:,} of {total:,}"
    command = f"python -m stages.verify --set verify.store={view.path}"
    return Text(
        f"Metadata, clocks, offsets and the features of {rows} VL rows give the checksums that "
        "were written with them. Those of sensor, state and actions were not read"
        f"{'' if looked == total else ', nor those of the other rows'}: `{command}` reads every "
        "byte."
    )


def _coverage(view: StoreView) -> list[Block]:
    episodes = view.episodes
    blocks: list[Block] = [
        _sources(view),
        Picture(
            "coverage",
            "Length of each episode, and below it which streams and views its ticks see.",
            partial(pictures.coverage, view),
        ),
    ]
    heads = ("source", "episode", "instruction", "ticks", "length [s]", "VL rows", "ticks see")
    said = "Ticks see all streams and views, none of one (no …), or one in a share of them."
    if len(episodes) > ROWS:
        said += f" The first {ROWS} of {len(episodes)} episodes."
    return [*blocks, Table(heads, [_episode(one) for one in episodes[:ROWS]], said)]


def _sources(view: StoreView) -> Table:
    rows: list[tuple[object, ...]] = []
    for source in view.sources:
        own = [one for one in view.episodes if one.source == source]
        formats = ", ".join(sorted({one.format for one in own}))
        rows.append((source, formats, len({one.instruction for one in own}), *_sums(own)))
    if len(rows) > 1:
        said = len({one.instruction for one in view.episodes})
        rows.append(("all", "", said, *_sums(view.episodes)))
    heads = ("source", "format", "instructions", "episodes", "ticks", "length [s]", "VL rows")
    total = frozenset({len(rows) - 1}) if len(rows) > 1 else frozenset[int]()
    return Table((*heads, "sensor readings", "state readings"), rows, strong=total)


def _sums(own: Sequence[EpisodeCoverage]) -> tuple[object, ...]:
    return (
        len(own),
        sum(one.ticks for one in own),
        round(sum(one.seconds for one in own), 1),
        sum(one.vl_rows for one in own),
        *(sum(one.readings[name] for one in own) for name in ("sensor", "state")),
    )


def _episode(one: EpisodeCoverage) -> tuple[object, ...]:
    return (
        one.source,
        one.id,
        one.instruction,
        one.ticks,
        round(one.seconds, 2),
        one.vl_rows,
        _seen(one.covered),
    )


def _seen(covered: Mapping[str, float]) -> str:
    """What not all ticks see; a partial share is never rounded to all or none."""
    lacking = [
        f"{min(max(share, 0.01), 0.99):.0%} {name}" if share else f"no {name}"
        for name, share in covered.items()
        if share < 1
    ]
    return ", ".join(lacking) or "all"


def _ages(view: StoreView) -> list[Block]:
    newest = view.ages.newest
    rows = [("newest frame", *_spread(newest))]
    for name, age in zip(view.ages.views, view.ages.by_view.T, strict=True):
        shown = age[np.isfinite(age)]
        if len(shown):
            rows.append((name, *_spread(shown)))
    return [
        Text(
            "Ticks between two VL rows reuse the last, so what the model saw grows older until the "
            "next; a camera slower than the ticks adds to it. The policy is given the age of the "
            "newest frame as `feature_age`."
        ),
        Picture(
            "ages",
            "Share of the ticks by the age of what they see: of the newest frame, filled, and of "
            "each view's; the dashed line is the time of one VL row.",
            partial(pictures.ages, view),
        ),
        Table(("age [s] of", "1 %", "median", "99 %", "oldest"), rows),
    ]


def _spread(age: NDArray[np.float32]) -> list[float]:
    return [*np.quantile(age, (0.01, 0.5, 0.99)).tolist(), float(age.max())]


def _sizes(view: StoreView) -> list[Block]:
    rows = [
        (
            one.name,
            " × ".join(f"{count:,}" for count in one.shape),
            one.dtype,
            one.chunks,
            one.disk_bytes / 2**20,
            100 * one.disk_bytes / max(1, view.disk_bytes),
        )
        for one in view.sizes
    ]
    return [
        Picture("sizes", "Bytes on the disk by array.", partial(pictures.sizes, view)),
        Table(("array", "shape", "dtype", "chunks", "on the disk [MiB]", "share [%]"), rows),
    ]


def _channels(view: StoreView) -> list[Block]:
    channels: list[ChannelStatistics] = [one for each in view.statistics for one in each.channels]
    looked = ", ".join(
        f"{one.stream}: {_of_rows(one.looked_at, one.rows)}" for one in view.statistics
    )
    table = statistics_table(channels)
    blocks: list[Block] = [
        Text(f"Over the whole store, before any normalisation. Looked at: {looked}."),
        replace(table, caption=table.caption.replace("Over the whole episode", "Physical units")),
    ]
    if any(pictures.numbered(view)):
        said = "Numbered channels side by side: median, 1 to 99 %, least and greatest."
        picture = Picture("wide_channels", said, partial(pictures.wide_channels, view))
        blocks.insert(1, picture)
    return blocks


def _of_rows(looked: int, rows: int) -> str:
    return f"all {rows:,} rows" if looked == rows else f"{looked:,} of {rows:,}, evenly spread"


def _documents(view: StoreView) -> list[Block]:
    computed = {
        f"VL rows {one['rows'][0]} to {one['rows'][1] - 1}": {
            name: value for name, value in one.items() if name != "rows"
        }
        for one in view.environments
    }
    streams = {name: said for name, said in view.streams.items() if name != "views"}
    described = {name: _described(said) for name, said in streams.items()}
    return [
        Document("Feature spec", view.spec),
        Document("Streams", {**described, "views": view.streams["views"]}),
        Document("Computed with", computed),
    ]


def _described(said: Mapping[str, Any]) -> dict[str, Any]:
    """Channels with their units; of a thousand, the first."""
    pairs = list(zip(said["names"], said["units"], strict=True))
    channels = {name: unit or "no unit" for name, unit in pairs[:_CHANNELS]}
    if len(pairs) > _CHANNELS:
        channels["…"] = f"{len(pairs) - _CHANNELS:,} more"
    kind = {"kind": said["kind"]} if "kind" in said else {}
    return {**kind, "channels": channels}

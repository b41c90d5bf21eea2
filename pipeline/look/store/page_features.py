"""The parts of a store's page that show its features."""

from collections.abc import Sequence
from functools import partial
from typing import Literal

from pipeline.look.page.blocks import Block, Chart, Picture, Table, Text
from pipeline.look.page.style import PALETTE
from pipeline.look.store import draw_features as pictures
from pipeline.look.store import draw_interactive as interactive
from pipeline.look.store.facts import StoreView, Twins

_TWINS = 20


def features(view: StoreView) -> list[Block]:
    """Norms and the projection."""
    if not len(view.sampled.rows):
        return [Text("Every VL row looked at holds features that are no numbers.")]
    beside = " and has a second picture by source" if len(view.sources) > 1 else ""
    planes: list[tuple[Literal["episode", "progress"], str]] = [
        (
            "episode",
            f"{_colours(view)} Hovering names the episode. The PNG joins the rows of each episode "
            f"in order of time, in colours that repeat after {len(PALETTE)}{beside}.",
        ),
        ("progress", "its colour is how far its episode had come. Hovering names the episode."),
    ]
    return [
        Text(_looked_at(view)),
        Picture(
            "norms",
            "Left: how long the features of each slot are. Right: their median length in each "
            "episode divided by that in all; a column that stands out is an episode unlike others.",
            partial(pictures.norms, view),
        ),
        Text(
            "Below, the first two principal components of all slots side by side, each less its "
            "mean, none scaled. Dots that lie apart look different to the model; dots that lie "
            "together may differ in the share of the variance that the axes do not hold."
        ),
        *(
            Chart(
                Picture(
                    f"projection_{by}",
                    f"Features in a plane: a dot is a VL row, {said}",
                    partial(pictures.projection, view, by),
                ),
                interactive.projection(view, by),
            )
            for by, said in planes
        ),
    ]


def _colours(view: StoreView) -> str:
    kind = interactive.trait(view)
    if kind is None:
        return f"its colour is its episode's, the same after every {len(PALETTE)}."
    return f"its colour is its {kind}'s, which the legend names."


def _looked_at(view: StoreView) -> str:
    sampled = view.sampled
    said = "Looked at: all VL rows"
    if sampled.looked_at < sampled.total:
        said = f"Looked at: {sampled.looked_at:,} of {sampled.total:,} VL rows, the same moments "
        said += "of each episode (`inspect.points`)"
    said += ", plain frames only" if view.variants > 1 else ""
    return (
        f"{said}, but {sampled.left_out:,} with what is not finite."
        if sampled.left_out
        else f"{said}."
    )


def duplicates(view: StoreView) -> list[Block]:
    """What the same features and the same inputs say twice."""
    found = view.duplicates
    looked = len(view.sampled.rows)
    blocks: list[Block] = [
        Text(
            f"Near-duplicates are VL rows whose features, less their mean over the store, have a "
            f"cosine similarity of at least {found.threshold:g} "
            f"(`inspect.duplicate_similarity`): {found.within:,} of {looked:,} have one in their "
            f"own episode, {found.across:,} in another; the scene stands still for "
            f"{found.still_count:,} stretches. By their keys, {found.equal_rows:,} of "
            f"{view.sampled.total:,} have exactly the frames and prompt of another row; pairs of "
            f"episodes with such rows: {found.equal_twins_count:,}."
        )
    ]
    if len(found.episodes) > 1:
        said = "For each pair of episodes, how alike their two most alike VL rows are; the mark on "
        framed = len(found.episodes) <= pictures.FRAMED_EPISODES
        said += "the scale is where near-duplicates begin"
        said += ", and pairs beyond it are framed." if framed else "."
        blocks.append(Picture("likeness", said, partial(pictures.likeness, view)))
    blocks += _twins(found.equal_twins, found.equal_twins_count, "Rows with equal keys")
    blocks += _twins(found.twins, found.twins_count, "Near-duplicates by features")
    if found.still:
        rows = [(one.episode, one.start_s, one.stop_s, one.rows) for one in found.still[:_TWINS]]
        said = f"Where the scene stands still: {_of(len(rows), found.still_count)}."
        blocks.append(Table(("episode", "from [s]", "to [s]", "rows looked at"), rows, said))
    return blocks


def _twins(pairs: Sequence[Twins], count: int, said: str) -> list[Block]:
    if not pairs:
        return []
    heads = ("episode", "rows", "at [s]", "other episode", "rows ", "at [s] ", "similarity")
    rows: list[tuple[object, ...]] = []
    for one in pairs[:_TWINS]:
        first, second = zip((one.first, one.second), one.rows, one.time_s, strict=True)
        rows.append((*first, *second, f"{one.similarity:.6f}"))
    return [Table(heads, rows, f"{said}, in different episodes: {_of(len(rows), count)}.")]


def _of(shown: int, count: int) -> str:
    return f"all {count:,}" if shown == count else f"the first {shown:,} of {count:,}"

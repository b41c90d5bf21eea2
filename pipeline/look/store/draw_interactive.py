"""The features of a store in a plane that can be zoomed and hovered."""

import html
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from pipeline.look.page.style import PALETTE
from pipeline.look.store.draw_features import PROGRESS
from pipeline.look.store.facts import StoreView

Trait = Literal["episode", "source", "instruction"]

_LABEL = 32
"""Characters of a name in the legend; hovering tells it whole."""


def trait(view: StoreView) -> Trait | None:
    """What colours tell apart: episodes where each can have its own, else sources, else tasks.

    None where all of them are too many, or one: then colours are the episodes', and repeat.
    """
    shown = view.projection.episode
    if len(np.unique(shown)) <= len(PALETTE):
        return "episode"
    kinds: tuple[Trait, ...] = ("source", "instruction")
    for kind in kinds:
        if 1 < len(set(_values(view, kind)[shown])) <= len(PALETTE):
            return kind
    return None


def projection(view: StoreView, by: Literal["episode", "progress"]) -> go.Figure:
    """VL rows on the first two principal components of their features, coloured by one trait.

    Hovering names the episode, the VL row, its time and its progress; `trait` says what the colours
    of `by="episode"` are, which the legend names.
    """
    found = view.projection
    figure = go.Figure(layout=layout())
    every = np.ones(len(found.points), np.bool_)
    kind = trait(view)
    if by == "progress":
        bar = {"title": {"text": "progress"}, "thickness": 12, "outlinewidth": 0}
        scale = {"colorscale": list(PROGRESS), "cmin": 0.0, "cmax": 1.0, "colorbar": bar}
        _dots(figure, view, every, {"color": found.progress, **scale})
    elif kind is None:
        colours = [PALETTE[one % len(PALETTE)] for one in found.episode.tolist()]
        _dots(figure, view, every, {"color": colours})
    else:
        values = _values(view, kind)[found.episode]
        for number, value in enumerate(dict.fromkeys(values)):
            _dots(figure, view, values == value, {"color": PALETTE[number]}, _label(value))
    for axis, share, number in zip(
        (figure.update_xaxes, figure.update_yaxes), found.explained, (1, 2), strict=True
    ):
        axis(title=f"component {number} ({share:.0%} of the variance)")
    named = by == "episode" and kind is not None
    legend = {"orientation": "h", "y": -0.15, "yanchor": "top", "itemsizing": "constant"}
    figure.update_layout(height=560 if named else 520, showlegend=named, legend=legend)
    return figure


def _values(view: StoreView, kind: Trait) -> NDArray[Any]:
    """(episode,) what each episode of the store is called, comes from or is told."""
    names = {"episode": "name", "source": "source", "instruction": "instruction"}
    return np.array([getattr(one, names[kind]) for one in view.episodes], dtype=object)


def _label(value: str) -> str:
    """The end of a long name, which tells it from its neighbours."""
    return plain(value if len(value) <= _LABEL else f"…{value[1 - _LABEL :]}")


def _dots(
    figure: go.Figure,
    view: StoreView,
    own: NDArray[np.bool_],
    marker: Mapping[str, Any],
    name: str = "",
) -> None:
    found = view.projection
    figure.add_trace(
        go.Scattergl(
            x=found.points[own, 0],
            y=found.points[own, 1],
            mode="markers",
            name=name,
            marker={"size": 5, "opacity": 0.8, **marker},
            text=[plain(found.episodes[episode]) for episode in found.episode[own].tolist()],
            customdata=np.column_stack([found.rows, found.time, found.progress])[own],
            hovertemplate=(
                "%{text}<br>VL row %{customdata[0]:d}, %{customdata[1]:.2f} s"
                "<br>progress %{customdata[2]:.2f}<extra></extra>"
            ),
        )
    )


def layout() -> dict[str, Any]:
    """Of every chart: axes that are seen on white and on black, and no background."""
    axis = {
        "gridcolor": "rgba(136, 136, 136, 0.3)",
        "linecolor": "#888888",
        "zeroline": False,
        "automargin": True,
    }
    return {
        "template": "none",
        "paper_bgcolor": "rgba(0, 0, 0, 0)",
        "plot_bgcolor": "rgba(0, 0, 0, 0)",
        "margin": {"l": 10, "r": 10, "t": 10, "b": 45},
        "xaxis": axis,
        "yaxis": axis,
        "dragmode": "pan",
        "hovermode": "closest",
    }


def plain(name: str) -> str:
    """A recording's name for plotly, which reads texts as HTML."""
    return html.escape(name, quote=False)

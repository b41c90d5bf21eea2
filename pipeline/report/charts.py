"""A plotly figure -> JSON for the page's script, which draws it in the page's own ink."""

import json
from typing import Any

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pipeline.plots.style import GRID, INK

INK_NAME, GRID_NAME = "@ink", "@grid"
"""What the script replaces with the page's colours whenever light and dark change."""


def plotly_script() -> Markup:
    """The whole of plotly.js, for a `<script>` element."""
    return Markup(get_plotlyjs())


def chart_json(figure: Any) -> Markup:
    """Data and layout of a `plotly.graph_objects.Figure`, fit to stand in a `<script>` element.

    The same figure gives the same bytes.
    """
    document = json.loads(figure.to_json())
    kept = {
        "data": document["data"],
        # The template repeats plotly's defaults and its light background.
        "layout": {key: value for key, value in document["layout"].items() if key != "template"},
    }
    text = json.dumps(kept, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
    for colour, name in ((INK, INK_NAME), ("#000000", INK_NAME), (GRID, GRID_NAME)):
        for spelling in {colour.lower(), colour.upper()}:
            text = text.replace(f'"{spelling}"', f'"{name}"')
    # Nothing in a <script> may look like its end or like a comment.
    return Markup(text.replace("<", "\\u003c"))

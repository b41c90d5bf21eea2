"""A plotly figure -> JSON for the page's script, which draws it in the page's own ink."""

import base64
import gzip
import json
import re
from typing import Any

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pipeline.look.page.svg import COLOURS


def plotly_script() -> Markup:
    """The whole of plotly.js as base64 of gzip, which `charts.js` unpacks."""
    # Without its time the same script is the same bytes.
    return Markup(base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode())


def chart_json(figure: Any) -> Markup:
    """Data and layout of a `plotly.graph_objects.Figure`, fit to stand in a `<script>` element.

    The same figure gives the same bytes. `"@ink"` and the like are the page's own colours, which
    the script puts in whenever light and dark change.
    """
    document = json.loads(figure.to_json())
    kept = {
        "data": document["data"],
        # The template repeats plotly's defaults and its light background.
        "layout": {key: value for key, value in document["layout"].items() if key != "template"},
    }
    text = json.dumps(kept, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
    for colour, name in COLOURS.items():
        text = re.sub(f'"{colour}"', f'"@{name}"', text, flags=re.IGNORECASE)
    # Nothing in a <script> may look like its end or like a comment.
    return Markup(text.replace("<", "\\u003c"))

"""All places of a page's findings as a table for programs."""

import csv
import io

from pipeline.look.page.blocks import Notices, Place

FINDINGS = "findings.csv"
_HEADS = ("severity", "kind", "stream", "episode", "start_s", "stop_s", "message")


def findings_csv(found: Notices) -> str:
    """A line a place, in the order of the notices; times are seconds as the page counts them."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_HEADS)
    for notice in found.notices:
        for place in notice.places:
            table.writerow((notice.severity, notice.kind, *_cells(place)))
    return text.getvalue()


def _cells(place: Place) -> tuple[str, ...]:
    start, stop = ("" if at is None else f"{at:.3f}" for at in (place.start_s, place.stop_s))
    return place.stream, place.episode, start, stop, place.message

"""Changes of a checkpoint's documents."""

import json
from collections.abc import Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any


def edit(path: Path, entries: Mapping[str, Any]) -> None:
    """Give a JSON document, which may not be there yet, values by their places; None removes."""
    document = json.loads(path.read_text()) if path.exists() else {}
    for place, value in entries.items():
        *outer, last = place.split(".")
        inside = reduce(getitem, outer, document)
        inside[last] = value
        if value is None:
            del inside[last]
    path.write_text(json.dumps(document))

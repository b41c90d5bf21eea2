"""A change of what a feature is must raise EXTRACTOR_VERSION, or stores would mix two meanings.

After a change that is meant: raise `EXTRACTOR_VERSION` in pipeline/vlm/feature_spec.py, then run
`WRITE_GOLDEN_FEATURES=1 python -m pytest tests/vlm/test_golden_features.py` and commit the file.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.vlm.feature_spec import EXTRACTOR_VERSION

GOLDEN = Path(__file__).with_name("golden_features.json")
SHOWN = 4
"""Values kept of each slot."""
POOLINGS = ["mean", "image_mean", "text_mean", "view_mean", "last"]


def _features(extractor, make_frame):
    views = ("View1", "View2")
    frames = {view: make_frame(seed, 120, 160) for seed, view in enumerate(views)}
    jobs = [
        ("insert the needle into the phantom", frames),
        ("stop", {"View2": frames["View2"]}),
    ]
    shown: dict[str, list[float]] = {}
    for asked in (
        {"layers": [-1, 1], "norms": [True, False], "pooling": POOLINGS},
        {"pooling": ["grid"]},
    ):
        ours = extractor(views=views, **asked)
        features, _ = ours.model.encode([ours.preparer.prepare(*job) for job in jobs])
        for index, row in enumerate(features):
            for slot, values in zip(ours.spec.slots, row, strict=True):
                name = " ".join(f"{key}={value}" for key, value in slot.document().items())
                shown[f"row {index} {name}"] = [round(float(v), 4) for v in values[:SHOWN]]
    return shown


def _write(features):
    lines = ",\n".join(f"    {json.dumps(name)}: {values}" for name, values in features.items())
    GOLDEN.write_text(
        f'{{\n  "extractor_version": {EXTRACTOR_VERSION},\n  "features": {{\n{lines}\n  }}\n}}\n'
    )


def _largest_difference(a, b):
    if a.keys() != b.keys():
        return float("inf")
    return max(float(np.abs(np.subtract(a[key], b[key])).max()) for key in a)


def test_features_are_those_of_this_extractor_version(extractor, make_frame):
    features = _features(extractor, make_frame)
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else None
    moved = golden is None or _largest_difference(features, golden["features"]) > 2e-3
    if golden and moved and golden["extractor_version"] == EXTRACTOR_VERSION:
        pytest.fail(
            f"features differ from {GOLDEN.name}, yet EXTRACTOR_VERSION is still "
            f"{EXTRACTOR_VERSION}. If the code changed what a feature is, raise it in "
            "pipeline/vlm/feature_spec.py; if only the demo checkpoint changed, delete the file. "
            "Then run WRITE_GOLDEN_FEATURES=1 python -m pytest tests/vlm/test_golden_features.py"
        )
    if os.environ.get("WRITE_GOLDEN_FEATURES"):
        _write(features)
    elif golden is None or golden["extractor_version"] != EXTRACTOR_VERSION:
        pytest.fail(
            f"{GOLDEN.name} is not of extractor version {EXTRACTOR_VERSION}. Run "
            "WRITE_GOLDEN_FEATURES=1 python -m pytest tests/vlm/test_golden_features.py"
        )

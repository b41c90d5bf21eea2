"""After a merge, an extraction over all the sources finds every row by its key."""

import pytest

from pipeline.base.errors import StoreMismatch
from pipeline.extract import extract
from pipeline.store import FeatureStore
from pipeline.store.merging import merge


def test_a_merged_store_gives_every_row_to_an_extraction_of_all_sources(
    changed, recordings, tmp_path, no_model_later
):
    """Both views in both, for the union of views is part of a feature's identity."""
    sources = [
        {"name": "first", "path": "Touch_dot/episode_1"},
        {"name": "second", "path": "Touch_dot/episode_2"},
    ]
    for source in sources:
        store = str(tmp_path / f"{source['name']}.zarr")
        extract(changed(data={"sources": [source]}, extract={"store": store}), print)
    target = tmp_path / "both.zarr"
    merge([tmp_path / "first.zarr", tmp_path / "second.zarr"], target)
    merged = FeatureStore.open(target)
    before = {one.id: merged.array("vl/features")[list(one.vl_rows)] for one in merged.episodes}

    only_first = changed(data={"sources": sources[:1]}, extract={"store": str(target)})
    with pytest.raises(StoreMismatch, match=r"merged of others and holds 1 episode\(s\) that"):
        extract(only_first, print)
    assert FeatureStore.open(target).attrs["plan"] == merged.attrs["plan"], "nothing was replaced"

    no_model_later()
    report = extract(changed(data={"sources": sources}, extract={"store": str(target)}), print)
    assert (report.computed, report.taken) == (0, report.rows)
    after = FeatureStore.open(target)
    assert after.sources == ["first", "second"]
    for one in after.episodes:
        assert (after.array("vl/features")[list(one.vl_rows)] == before[one.id]).all()

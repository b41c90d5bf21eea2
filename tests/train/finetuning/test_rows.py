"""A row of the store shows the very frames that extraction saw."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.data.episode import by_episode
from pipeline.extract import extract
from pipeline.simulation.insertion_formats import write_lerobot
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore
from pipeline.train.finetuning_rows import LiveRows, check_spec, find_recordings, known_digests
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.preparation import PreparedRow, Preparer


class Watched(Preparer):
    """Notes the key of each row it makes."""

    def __init__(self, params: Params, spec: FeatureSpec) -> None:
        super().__init__(params.vlm, spec)
        self.spec = spec
        self.keys: Counter[bytes] = Counter()

    def prepare(self, instruction: str, frames: Mapping[str, NDArray[np.uint8]]) -> PreparedRow:
        prompt = self.render(instruction, list(frames))
        self.keys[self.spec.row_key(prompt, frames)] += 1
        return super().prepare(instruction, frames)


def live_rows(store: FeatureStore, params: Params, **arguments: Any) -> tuple[LiveRows, Watched]:
    with known_digests(store) as digests:
        watched = Watched(params, check_spec(store, params, digests))
    return LiveRows(store, find_recordings(store, params), watched, **arguments), watched


def keys(store: FeatureStore, rows: NDArray[np.int64]) -> Counter[bytes]:
    return Counter(store.array("vl/key")[row].tobytes() for row in np.unique(rows))


def prepare_all(rows: LiveRows, wanted: NDArray[np.int64]) -> dict[int, PreparedRow]:
    return {
        row: prepared
        for _, piece in by_episode(np.unique(wanted), rows.vl_start)
        for row, prepared in zip(piece.tolist(), rows.prepare(piece), strict=True)
    }


def test_rows_show_what_extraction_saw_and_are_decoded_once(store, params):
    rows, watched = live_rows(store, params())
    wanted = np.random.default_rng(0).integers(0, len(store.array("vl/time")), 200)
    first = prepare_all(rows, wanted[:10])
    again = prepare_all(rows, wanted)
    assert watched.keys == keys(store, wanted)
    assert all(again[row] is prepared for row, prepared in first.items())


def test_rows_of_a_video_are_read_in_one_pass(document, params, tmp_path):
    write_lerobot(tmp_path / "videos", [simulate_episode(5, 1.7e9)])
    document["data"] = {
        "root": str(tmp_path),
        "sources": [{"name": "video", "path": "videos"}],
        "views": ["View1", "View5"],
        "vlm_reuse_count": 10,
    }
    document["extract"]["store"] = str(tmp_path / "video.zarr")
    extract(params(), say=lambda _: None)
    store = FeatureStore.open(tmp_path / "video.zarr")
    rows, watched = live_rows(store, params())
    wanted = np.array([3, 0, 4, 3])
    prepare_all(rows, wanted)
    assert watched.keys == keys(store, wanted)


def test_kept_rows_stay_within_their_bytes(store, params):
    last = store.episodes[-1].vl_rows
    size = 2 * 56 * 84 * 3
    rows, watched = live_rows(store, params(), cache_bytes=3 * size)
    for row in (*range(last.start, last.start + 4), last.start + 3, last.start):
        rows.prepare(np.array([row]))
    assert watched.keys.total() == 5, "the first row has made room, the newest has not"
    none, watched = live_rows(store, params(), cache_bytes=0)
    for _ in range(2):
        none.prepare(np.array([last.start]))
    assert watched.keys.total() == 2

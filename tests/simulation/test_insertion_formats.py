"""The demo's LeRobot set follows v2.1, as its own readers expect it."""

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.simulation.rendering import HEIGHT, VIEWS, WIDTH


@pytest.fixture
def root(demo_root: Path) -> Path:
    return demo_root / "lerobot"


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_meta_agrees_with_the_files(root) -> None:
    info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    episodes = lines(root / "meta" / "episodes.jsonl")
    first = 0
    for episode in episodes:
        place = {"episode_chunk": 0, "episode_index": episode["episode_index"]}
        table = pq.read_table(root / info["data_path"].format(**place))
        videoless = {k for k, f in info["features"].items() if f["dtype"] != "video"}
        assert set(table.column_names) == videoless
        assert table.num_rows == episode["length"]
        assert table["index"].to_pylist() == list(range(first, first + episode["length"]))
        np.testing.assert_allclose(
            table["timestamp"].to_numpy(), np.arange(episode["length"]) / info["fps"], rtol=1e-6
        )
        first += episode["length"]
    assert info["total_frames"] == first and info["total_episodes"] == len(episodes)
    for name in ("observation.state", "action"):
        feature = info["features"][name]
        assert len(feature["names"]) == len(feature["units"]) == feature["shape"][0]


@pytest.mark.parametrize("view", VIEWS)
def test_every_frame_decodes(root, view: str) -> None:
    info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    key = f"observation.images.{view}"
    for episode in lines(root / "meta" / "episodes.jsonl"):
        place = {"episode_chunk": 0, "episode_index": episode["episode_index"]}
        path = root / info["video_path"].format(video_key=key, **place)
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
            codec = container.streams.video[0].codec_context.name
        assert len(frames) == episode["length"]
        assert frames[0].shape == (HEIGHT, WIDTH, 3)
        assert codec == info["features"][key]["info"]["video.codec"]


def test_statistics_are_those_of_the_rows(root) -> None:
    for row in lines(root / "meta" / "episodes_stats.jsonl"):
        name = f"episode_{row['episode_index']:06d}.parquet"
        table = pq.read_table(root / "data" / "chunk-000" / name)
        for feature in ("observation.state", "action"):
            values = np.stack(table[feature].to_pylist())
            stats = row["stats"][feature]
            np.testing.assert_allclose(stats["mean"], values.mean(0), rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(stats["max"], values.max(0), rtol=1e-6)
            assert stats["count"] == [len(values)]
        image = row["stats"]["observation.images.View2"]
        assert np.shape(image["mean"]) == (3, 1, 1)
        assert 0 <= np.min(image["min"]) < np.max(image["max"]) <= 1

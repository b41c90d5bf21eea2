"""The recordings of a store are found again, and only if they are the same."""

import json
import shutil

import pytest
from PIL import Image

from pipeline.base.config import Params
from pipeline.base.errors import StoreMismatch
from pipeline.store import FeatureStore
from pipeline.train.finetuning_rows import (
    check_recordings,
    check_spec,
    find_recordings,
    known_digests,
)

TASK = "Follow_disc"


def check(store: FeatureStore, params: Params) -> None:
    with known_digests(store) as digests:
        check_recordings(store, find_recordings(store, params), digests)


def test_recordings_come_in_the_order_of_episodes_wherever_they_lie(store, params, own_recordings):
    added = own_recordings / TASK / "episode_00"
    shutil.copytree(own_recordings / TASK / "episode_0", added)
    found = find_recordings(store, params())
    assert [one.id for one in found] == [one.id for one in store.episodes]
    assert all(one.path.is_relative_to(own_recordings) for one in found)
    assert added not in [one.path for one in found], "it is not in the store"
    check(store, params())


def test_a_missing_recording_is_named(store, params, own_recordings):
    shutil.rmtree(own_recordings / TASK / "episode_2")
    (own_recordings / TASK / "episode_1" / "metadata.json").write_text("{")
    with pytest.raises(StoreMismatch) as refused:
        find_recordings(store, params())
    said = str(refused.value)
    assert "of its 4 episodes 2 cannot be found" in said
    assert f"made/episode_2: no source has it; it was extracted from {TASK}/episode_2" in said
    assert "made/episode_1: " in said
    assert "metadata.json" in said, "why it cannot be read"


def test_a_changed_file_is_named(store, params, own_recordings):
    frame = next((own_recordings / TASK / "episode_1" / "images" / "View1").iterdir())
    Image.new("RGB", (64, 48)).save(frame)
    with pytest.raises(StoreMismatch, match=r"made/episode_1: the files in .* changed since"):
        check(store, params())


def test_another_instruction_is_named(store, params):
    told = params(data={"sources": [{"name": "made", "path": ".", "instruction": "Run away"}]})
    with pytest.raises(StoreMismatch, match="'Follow disc' at extraction, 'Run away' now"):
        check(store, told)


def test_the_model_of_the_store_is_asked_for(store, params):
    with known_digests(store) as digests:
        assert check_spec(store, params(), digests).digest == store.spec["digest"]
        # What decides no feature may differ.
        check_spec(store, params(extract={"dtype": "float16"}), digests)


def test_another_model_is_refused_with_the_entries_that_differ(store, params):
    vlm = json.loads(params().vlm.model_dump_json()) | {"image_resize_height": 84}
    refused = pytest.raises(StoreMismatch, match=r"processor\.image_size")
    with known_digests(store) as digests, refused:
        check_spec(store, params(vlm=vlm), digests)

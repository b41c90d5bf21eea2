"""A data set of the Hugging Face Hub, read from a cache as the Hub's library lays it out."""

import shutil

import pytest

from pipeline.base.config import Source
from pipeline.base.errors import ConfigError
from pipeline.data import open_recordings


@pytest.fixture
def cached(data_set, tmp_path, monkeypatch):
    """The cache of a machine without network; it holds one revision of `someone/set`."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    repo = tmp_path / "datasets--someone--set"
    blobs, snapshot = repo / "blobs", repo / "snapshots" / ("a" * 40)
    for count, path in enumerate(sorted(data_set.rglob("*"))):
        place = snapshot / path.relative_to(data_set)
        if path.is_file():
            place.parent.mkdir(parents=True, exist_ok=True)
            blobs.mkdir(exist_ok=True)
            shutil.copy(path, blobs / str(count))
            place.symlink_to(blobs / str(count))
    for name in ("main", "v2"):
        (repo / "refs").mkdir(exist_ok=True)
        (repo / "refs" / name).write_text("a" * 40)
    return snapshot


@pytest.fixture
def data_set(tmp_path, write):
    """The same LeRobot data set in a folder."""
    write.lerobot(tmp_path / "banana", "v3.0")
    return tmp_path / "banana"


@pytest.mark.parametrize("hub", ["someone/set", "someone/set@v2"])
def test_is_read_from_the_cache_of_the_hub_like_the_same_folder(hub, cached, data_set, tmp_path):
    by_path = open_recordings([Source(name="s", path=str(data_set))]).recordings
    by_hub = open_recordings([Source(name="s", hub=hub)], tmp_path / "no root").recordings
    assert len(by_hub) == len(by_path) > 0
    for there, here in zip(by_hub, by_path, strict=True):
        assert there.path == cached
        assert (there.action().values == here.action().values).all()
        assert there.cameras().keys() == here.cameras().keys()


@pytest.mark.parametrize(
    ("hub", "remedy"),
    [
        ("someone/other", "--repo-type dataset someone/other`"),
        ("someone/set@v9", "--repo-type dataset someone/set --revision v9`"),
    ],
)
def test_without_network_an_unknown_one_names_source_id_and_next_step(hub, remedy, cached):
    with pytest.raises(ConfigError) as refused:
        open_recordings([Source(name="s", hub=hub)])
    assert f"source 's': hub {hub}: cannot be downloaded: " in str(refused.value)
    assert remedy in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("places", "why"),
    [
        ({}, "either path or hub, found neither"),
        ({"path": "a", "hub": "b/c"}, "either path or hub, found both"),
        ({"hub": "pusht"}, "owner/name@revision, found 'pusht'"),
        ({"hub": "a/b/c"}, "owner/name@revision"),
        ({"hub": "a/b@"}, "owner/name@revision"),
    ],
)
def test_a_source_names_one_place(places, why):
    with pytest.raises(ValueError, match=why):
        Source(name="s", **places)

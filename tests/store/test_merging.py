"""Two stores become one, episode by episode and row by row, and nothing is computed."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr

from pipeline.base.errors import ConfigError, StoreIncomplete, StoreLocked, StoreMismatch
from pipeline.base.provenance import TunedOn, TunedPart, tuned_on_attributes, tuned_on_of_store
from pipeline.store import Episode, FeatureStore, build_lock, check_trailers
from pipeline.store.chunks import write_seal
from pipeline.store.episodes import FIELDS
from pipeline.store.merging import merge
from pipeline.store.schema import ARRAY_NAMES, POSITIONS, STREAMS
from tests.faults.killing import Killed
from tests.store.samples import chunk_file, content, flip

Make = Callable[..., Path]
WINDOWS = {"horizon": 3, "sensor_window": 6, "state_window": 5}


def rows_of(store: FeatureStore, episode: Episode) -> dict[str, np.ndarray]:
    """Every row of an episode by array, with positions counted from the episode's own start."""
    rows = {name: getattr(episode, stream.rows) for name, stream in STREAMS.items()}
    held = {}
    for name in ARRAY_NAMES:
        if (stream := name.split("/")[0]) in rows:
            held[name] = store.array(name)[rows[stream].start : rows[stream].stop]
            if name in POSITIONS:
                held[name] = held[name] - rows[POSITIONS[name]].start
    return held


def assert_holds(merged: FeatureStore, path: Path, names: dict[str, str] | None = None):
    """Every episode of a store is in `merged`, equal in every array; `names`: id -> new id."""
    store = FeatureStore.open(path)
    episodes = {(episode.source, episode.id): episode for episode in merged.episodes}
    for episode in store.episodes:
        taken = episodes[episode.source, (names or {}).get(episode.id, episode.id)]
        assert taken.digest == episode.digest
        assert (taken.content, taken.path) == (episode.content, episode.path)
        ours, theirs = rows_of(merged, taken), rows_of(store, episode)
        for name, values in theirs.items():
            if values.shape[0]:
                assert np.array_equal(ours[name], values, equal_nan=True), (episode.id, name)


def renamed(store: Path, ids: Callable[[str], str], digests: Callable[[str], str]) -> Path:
    """Other ids and digests of the episodes of a finished store, as of another extraction."""
    texts = [
        {name: getattr(episode, name) for name in FIELDS}
        | {"id": ids(episode.id), "digest": digests(episode.digest)}
        for episode in FeatureStore.open(store).episodes
    ]
    raw = [json.dumps(text).encode() for text in texts]
    for name, values in {
        "episode/text": np.frombuffer(b"".join(raw), np.uint8),
        "episode/text_start": np.cumsum([0, *map(len, raw)]),
    }.items():
        array = zarr.open_array(store, path=name, mode="r+")
        array.resize(len(values))
        array[:] = values
    write_seal(store)
    return store


@pytest.fixture
def inputs(tiny_store: Make, tmp_path: Path) -> list[Path]:
    """Two stores of the same form."""
    return [tiny_store(tmp_path, name=str(seed), seed=seed, ticks=12) for seed in (1, 2)]


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "both.zarr"


def test_all_episodes_follow_one_another(tiny_store: Make, tmp_path: Path, output: Path) -> None:
    first = tiny_store(tmp_path, name="first", seed=1)
    second = renamed(
        tiny_store(tmp_path, name="second", seed=2, episodes=3, ticks=17), lambda i: f"b_{i}", str
    )
    report = merge([first, second], output)
    merged, a, b = (FeatureStore.open(path) for path in (output, first, second))
    assert report is not None
    assert (len(report.episodes), report.twice) == (9, 0)
    assert report.count("vl") == len(merged.array("vl/time")) == 6 * 10 + 3 * 6
    assert merged.sources == ["left", "right"]
    assert_holds(merged, first)
    assert_holds(merged, second)
    ids = [episode.id for store in (a, b) for episode in store.episodes]
    assert [episode.id for episode in merged.episodes] == ids
    ticks = np.arange(3 * 17)
    ours, theirs = merged.gather(ticks + a.ticks, **WINDOWS), b.gather(ticks, **WINDOWS)
    for name in ("features", "sensor", "sensor_valid", "state", "action", "action_valid"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
    check_trailers(merged.path)
    group = zarr.open_group(merged.path, mode="r")
    assert np.array_equal(group["vl/features"][60:], b.array("vl/features")), "plain zarr reads it"


def test_an_input_that_is_held_in_part_gives_the_rest(
    tiny_store: Make, tmp_path: Path, output: Path
) -> None:
    """An episode under another name is another episode, whatever its content."""
    whole = tiny_store(tmp_path, name="whole")
    some = renamed(
        tiny_store(tmp_path, name="some"),
        lambda name: name if name < "episode_002" or name > "episode_003" else f"new_{name}",
        lambda digest: digest if digest not in ("0-2", "0-3") else f"new {digest}",
    )
    report = merge([some, whole], output)
    assert report is not None
    assert (len(report.episodes), report.twice) == (8, 4)
    merged = FeatureStore.open(output)
    assert [episode.id for episode in merged.episodes][6:] == ["episode_002", "episode_003"]
    assert_holds(merged, whole)
    assert_holds(merged, some)


def test_different_episodes_of_one_name_are_renamed(
    tiny_store: Make, tmp_path: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tiny_store(tmp_path, name="first", seed=1)
    second = tiny_store(tmp_path, name="second", seed=2, episodes=1)
    third = tiny_store(tmp_path / "third", name="second", seed=3, episodes=1)
    merge([first, second, third], output)
    assert "left/episode_000 is named 2/episode_000" in capsys.readouterr().out
    merged = FeatureStore.open(output)
    assert_holds(merged, second, {"episode_000": "2/episode_000"})
    assert_holds(merged, third, {"episode_000": "3/episode_000"})


def test_a_stream_that_one_lacks_is_that_of_the_other(
    tiny_store: Make, tmp_path: Path, output: Path
) -> None:
    blind = tiny_store(tmp_path, name="blind", sensor_channels=0, seed=1)
    whole = tiny_store(tmp_path, name="whole", seed=2)
    merge([blind, whole], output)
    merged = FeatureStore.open(output)
    assert merged.sensor_channels == 5
    assert merged.streams["sensor"] == FeatureStore.open(whole).streams["sensor"]
    assert not merged.gather(np.arange(180), **WINDOWS).sensor_valid.any()
    assert merged.gather(np.arange(180, 360), **WINDOWS).sensor_valid.all()


def test_rows_keep_their_environment_and_the_store_what_its_model_was_tuned_on(
    tiny_store: Make, tmp_path: Path, output: Path
) -> None:
    parts = [
        TunedPart(episode=f"lab/{n}", ticks=(0, 9), content=str(n), group=f"lab/{n}")
        for n in range(3)
    ]
    tuned = TunedOn(train=(parts[0],), val=(parts[1],)), TunedOn(train=(parts[0], parts[2]))
    inputs = [tiny_store(tmp_path, name=name, seed=n) for n, name in enumerate("ab")]
    environments = (
        [{"rows": [0, 60], "torch": "test"}],
        [{"rows": [0, 25], "torch": "old"}, {"rows": [25, 60], "torch": "test"}],
    )
    for path, tuned_on, environment in zip(inputs, tuned, environments, strict=True):
        attributes = tuned_on_attributes(tuned_on) | {"environment": environment}
        zarr.open_group(path, mode="r+").attrs.update(attributes)
        write_seal(path)
    merge(inputs, output)
    attributes = FeatureStore.open(output).attrs
    assert attributes["environment"] == [
        {"rows": [0, 60], "torch": "test"},
        {"rows": [60, 85], "torch": "old"},
        {"rows": [85, 120], "torch": "test"},
    ]
    assert tuned_on_of_store(attributes, output) == TunedOn(
        train=(parts[0], parts[2]), val=(parts[1],)
    )


def test_whole_chunks_of_the_first_are_linked(
    tiny_store: Make, tmp_path: Path, output: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
    first = tiny_store(tmp_path, name="first", seed=1, episodes=40)  # 9,600 readings
    second = tiny_store(tmp_path, name="second", seed=2)
    merge([first, second], output)
    ours, theirs = (
        [chunk_file(store, "sensor/values", chunk).stat().st_ino for chunk in range(3)]
        for store in (output, first)
    )
    assert ours[:2] == theirs[:2]
    assert ours[2] != theirs[2], "holds the end of the first and the beginning of the second"
    assert_holds(FeatureStore.open(output), first)


def test_merging_again_does_nothing(
    inputs: list[Path], output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    merge(inputs, output)
    inode = output.stat().st_ino
    assert merge(inputs, output) is None
    assert capsys.readouterr().out.endswith("up to date, nothing to do\n")
    assert output.stat().st_ino == inode
    (output / "vl/features/c/0/0/0").unlink()
    with pytest.raises(StoreIncomplete, match=r"no such file.*stages\.verify --repair"):
        merge(inputs, output)


class TestRefusals:
    @pytest.mark.parametrize(
        ("changed", "difference"),
        [
            ({"spec_digest": "another"}, r'feature spec.digest: "tiny-spec" -> "another"'),
            ({"reuse": 2}, r"vlm_reuse_count: 3 -> 2"),
            ({"sensor_channels": 4}, r'sensor.names: \[.*"sensor_4"\] -> \[.*"sensor_3"\]'),
            ({"dtype": "float16"}, r'features.dtype: "float32" -> "float16"'),
            ({"dim": 9}, r"features.row: \[3, 8\] -> \[3, 9\]"),
        ],
    )
    def test_what_differs_is_named(
        self, tiny_store: Make, tmp_path: Path, output: Path, changed, difference
    ) -> None:
        inputs = [tiny_store(tmp_path, name="a"), tiny_store(tmp_path, name="b", **changed)]
        with pytest.raises(StoreMismatch, match=rf"(?s)a\.zarr and .*b\.zarr.*{difference}"):
            merge(inputs, output)
        assert not list(tmp_path.glob("both.zarr.part"))

    def test_measured_rates_may_differ_a_little(self, inputs: list[Path], output: Path) -> None:
        attributes = zarr.open_group(inputs[1], mode="r+").attrs
        attributes["action_hz"] = 5.0
        write_seal(inputs[1])
        with pytest.raises(StoreMismatch, match=r"action_hz: 10\.0 -> 5\.0"):
            merge(inputs, output)
        attributes["action_hz"] = 9.998
        write_seal(inputs[1])
        merge(inputs, output)
        assert FeatureStore.open(output).action_hz == 10.0

    def test_paths(self, inputs: list[Path], tmp_path: Path, output: Path) -> None:
        a, b = inputs
        with pytest.raises(ConfigError, match="two or more stores"):
            merge([a], output)
        with pytest.raises(ConfigError, match="each named once"):
            merge([a, tmp_path / "x" / ".." / "1.zarr"], output)
        for wrong in (a, tmp_path / "c"):
            with pytest.raises(ConfigError, match="whose name ends in"):
                merge([a, b], wrong)
        with pytest.raises(StoreIncomplete, match="no finished store"):
            merge([a, tmp_path / "nowhere.zarr"], output)
        with build_lock(output), pytest.raises(StoreLocked, match=f"process {os.getpid()}"):
            merge(inputs, output)

    def test_another_store_or_build_in_its_place_is_left_alone(
        self, tiny_store: Make, inputs: list[Path], tmp_path: Path
    ) -> None:
        other = tiny_store(tmp_path, name="other", seed=3)
        before = content(other)
        with pytest.raises(StoreMismatch, match=r"other\.zarr: expected nothing.*found another"):
            merge(inputs, other)
        build = other.rename(tmp_path / "new.zarr.part")
        with pytest.raises(StoreMismatch, match=r"new\.zarr\.part: .*found another"):
            merge(inputs, tmp_path / "new.zarr")
        assert content(build) == before


def test_a_flipped_bit_is_never_copied(inputs: list[Path], output: Path) -> None:
    flip(chunk_file(inputs[1], "sensor/values"), 100)
    with pytest.raises(StoreIncomplete, match=r"(?s)2\.zarr.*stages\.verify"):
        merge(inputs, output)
    assert not output.exists()


def test_a_kill_at_any_write_ends_in_the_undisturbed_store(
    inputs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`pwrite` is what every byte of a build goes through."""
    monkeypatch.setattr("pipeline.store.merging._BLOCK_BYTES", 700)
    merge(inputs, tmp_path / "whole.zarr")
    whole, real = content(tmp_path / "whole.zarr"), os.pwrite
    for kill_at in (0, 41, 60, 85):
        writes, killed = iter(range(10**6)), tmp_path / f"{kill_at}.zarr"

        def pwrite(descriptor, block, offset, writes=writes, kill_at=kill_at):
            if next(writes) == kill_at:
                real(descriptor, bytes(block)[: len(block) // 2], offset)
                raise Killed
            return real(descriptor, block, offset)

        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", pwrite)
            with pytest.raises(Killed):
                merge(inputs, killed)
        assert not killed.exists()
        merge(inputs, killed)
        assert content(killed) == whole


def test_memory_stays_bounded(tiny_store: Make, tmp_path: Path, output: Path) -> None:
    """Two stores of 34 MB of sensor each are merged with less than that beyond the imports.

    Not by `ru_maxrss`: what a process is forked from counts in it.
    """
    wide = {"episodes": 4, "sensor_channels": 500, "readings_a_tick": 140}
    inputs = [tiny_store(tmp_path, name=str(seed), seed=seed, **wide) for seed in (1, 2)]
    code = """
import sys
from pathlib import Path
from pipeline.store import merging
from pipeline.store.merging import merge
merging._BLOCK_BYTES = 2**20
paths = [Path(path) for path in sys.argv[1:]]
def peak_kib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
before = peak_kib()
merge(paths[:2], paths[2])
print(peak_kib() - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *inputs, output], capture_output=True, text=True, check=True
    )
    assert int(done.stdout.split()[-1]) * 1024 < 30 * 2**20

"""Two stores become one, episode by episode and row by row, and nothing is computed."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr

from pipeline.base.errors import ConfigError, StoreIncomplete, StoreLocked, StoreMismatch
from pipeline.base.source import TunedOn, TunedPart, tuned_on_attributes, tuned_on_of_store
from pipeline.extract.repair import begin_from_store
from pipeline.store import FeatureStore, StoreBuild, build_lock, check_trailers
from pipeline.store.chunks import write_seal
from pipeline.store.merging import merge
from pipeline.store.schema import ARRAY_NAMES
from pipeline.store.verification import verify
from tests.faults.killing import Killed

Make = Callable[..., Path]
WINDOWS = {"horizon": 3, "sensor_window": 6, "state_window": 5}


def of_episode(store: FeatureStore, episode) -> dict[str, np.ndarray]:
    """Everything a store holds of an episode, indices counted from the episode's own beginning."""
    rows = {
        "tick": episode.ticks,
        "vl": episode.vl_rows,
        "sensor": episode.readings,
        "state": episode.states,
    }
    counted = {"tick/vl_row": "vl", "tick/sensor_end": "sensor", "tick/state_end": "state"}
    held = {}
    for name in ARRAY_NAMES:
        kind = name.split("/")[0]
        if kind != "episode":
            held[name] = store.array(name)[rows[kind].start : rows[kind].stop]
            if name in counted:
                held[name] = held[name] - rows[counted[name]].start
    return held


def assert_holds(merged: FeatureStore, store: FeatureStore, names: dict[str, str] | None = None):
    """Every episode of `store` stands in `merged`, equal in every array; `names`: id -> new id."""
    there = {(one.source, one.id): one for one in merged.episodes}
    for episode in store.episodes:
        found = there[episode.source, (names or {}).get(episode.id, episode.id)]
        assert (found.digest, found.content, found.path) == (
            episode.digest,
            episode.content,
            episode.path,
        )
        ours, theirs = of_episode(merged, found), of_episode(store, episode)
        for name, values in theirs.items():
            if values.shape[0]:
                assert np.array_equal(ours[name], values, equal_nan=True), (episode.id, name)


def renamed(store: Path, ids: Callable[[str], str], digests: Callable[[str], str]) -> Path:
    """Rewrite what a finished store says of its episodes, as another extraction would have."""
    opened = FeatureStore.open(store)
    said = [
        {
            name: getattr(one, name)
            for name in ("id", "path", "format", "instruction", "content", "digest")
        }
        | {"id": ids(one.id), "digest": digests(one.digest)}
        for one in opened.episodes
    ]
    texts = [json.dumps(one).encode() for one in said]
    for name, values in {
        "episode/text": np.frombuffer(b"".join(texts), np.uint8),
        "episode/text_start": np.cumsum([0, *map(len, texts)]),
    }.items():
        array = zarr.open_array(store, path=name, mode="r+")
        array.resize(len(values))
        array[:] = values
    write_seal(store)
    return store


def test_all_episodes_stand_one_behind_the_other(tiny_store: Make, tmp_path: Path) -> None:
    first = tiny_store(tmp_path, name="first", seed=1)
    second = renamed(
        tiny_store(tmp_path, name="second", seed=2, episodes=3, ticks=17), lambda i: f"b_{i}", str
    )
    report = merge([first, second], tmp_path / "both.zarr")
    merged, a, b = (FeatureStore.open(tmp_path / f"{n}.zarr") for n in ("both", "first", "second"))
    assert report is not None
    assert (len(report.episodes), report.twice) == (9, 0)
    assert report.count("vl") == len(merged.array("vl/time")) == 6 * 10 + 3 * 6
    assert merged.sources == ["left", "right"]
    assert_holds(merged, a)
    assert_holds(merged, b)
    assert [one.id for one in merged.episodes] == [
        *(one.id for one in a.episodes),
        *(one.id for one in b.episodes),
    ]
    ticks = np.arange(3 * 17)
    ours, theirs = merged.gather(ticks + a.ticks, **WINDOWS), b.gather(ticks, **WINDOWS)
    for name in ("features", "sensor", "sensor_valid", "state", "action", "action_valid"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
    check_trailers(merged.path)
    group = zarr.open_group(merged.path, mode="r")
    assert np.array_equal(group["vl/features"][60:], b.array("vl/features")), "plain zarr reads it"


def test_equal_episodes_once_equal_content_under_another_name_twice(
    tiny_store: Make, tmp_path: Path
) -> None:
    first = tiny_store(tmp_path, name="first")
    again = tiny_store(tmp_path / "again", name="first")
    other = renamed(
        tiny_store(tmp_path, name="other"), lambda name: f"other_{name}", lambda d: f"other {d}"
    )
    report = merge([first, again, other], tmp_path / "all.zarr")
    assert report is not None
    assert (len(report.episodes), report.twice) == (12, 6)
    merged = FeatureStore.open(tmp_path / "all.zarr")
    keys = merged.array("vl/key")
    assert np.array_equal(keys[:60], keys[60:])
    assert np.array_equal(merged.array("vl/features")[:60], merged.array("vl/features")[60:])


def test_an_input_that_is_held_in_part_gives_the_rest(tiny_store: Make, tmp_path: Path) -> None:
    whole = tiny_store(tmp_path, name="whole")
    some = renamed(
        tiny_store(tmp_path, name="some"),
        lambda name: name if name < "episode_002" or name > "episode_003" else f"new_{name}",
        lambda digest: digest if digest not in ("0-2", "0-3") else f"new {digest}",
    )
    report = merge([some, whole], tmp_path / "all.zarr")
    assert report is not None
    assert (len(report.episodes), report.twice) == (8, 4)
    merged = FeatureStore.open(tmp_path / "all.zarr")
    assert [one.id for one in merged.episodes][6:] == ["episode_002", "episode_003"]
    assert_holds(merged, FeatureStore.open(whole))
    assert_holds(merged, FeatureStore.open(some))


def test_different_episodes_of_one_name_are_named_apart(
    tiny_store: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tiny_store(tmp_path, name="first", seed=1)
    second = tiny_store(tmp_path, name="second", seed=2, episodes=1)
    third = tiny_store(tmp_path / "third", name="second", seed=3, episodes=1)
    merge([first, second, third], tmp_path / "all.zarr")
    assert "its left/episode_000 is another episode than that of" in capsys.readouterr().out
    merged = FeatureStore.open(tmp_path / "all.zarr")
    assert [one.id for one in merged.episodes][6:] == [
        "second/episode_000",
        "second-2/episode_000",
    ]
    assert_holds(merged, FeatureStore.open(second), {"episode_000": "second/episode_000"})
    assert_holds(merged, FeatureStore.open(third), {"episode_000": "second-2/episode_000"})


def test_a_stream_that_one_lacks_is_that_of_the_other(tiny_store: Make, tmp_path: Path) -> None:
    blind = tiny_store(tmp_path, name="blind", sensor_channels=0, seed=1)
    whole = tiny_store(tmp_path, name="whole", seed=2)
    merge([blind, whole], tmp_path / "both.zarr")
    merged = FeatureStore.open(tmp_path / "both.zarr")
    assert merged.sensor_channels == 5
    assert merged.streams["sensor"] == FeatureStore.open(whole).streams["sensor"]
    assert not merged.gather(np.arange(180), **WINDOWS).sensor_valid.any()
    assert merged.gather(np.arange(180, 360), **WINDOWS).sensor_valid.all()


def test_rows_keep_the_environment_they_were_computed_in(tiny_store: Make, tmp_path: Path) -> None:
    first, second = tiny_store(tmp_path, name="a", seed=1), tiny_store(tmp_path, name="b", seed=2)
    group = zarr.open_group(second, mode="r+")
    noted = [{"rows": [0, 25], "torch": "old"}, {"rows": [25, 60], "torch": "test"}]
    group.attrs.put({**group.attrs.asdict(), "environment": noted})
    write_seal(second)
    merge([first, second], tmp_path / "both.zarr")
    assert FeatureStore.open(tmp_path / "both.zarr").attrs["environment"] == [
        {"rows": [0, 60], "torch": "test"},
        {"rows": [60, 85], "torch": "old"},
        {"rows": [85, 120], "torch": "test"},
    ]


def test_what_the_model_was_tuned_on_is_that_of_both(tiny_store: Make, tmp_path: Path) -> None:
    parts = [
        TunedPart(episode=f"lab/{n}", ticks=(0, 9), content=str(n), group=f"lab/{n}")
        for n in range(3)
    ]
    told = TunedOn(train=(parts[0],), val=(parts[1],)), TunedOn(train=(parts[0], parts[2]))
    paths = [tiny_store(tmp_path, name=name, seed=n) for n, name in enumerate(("one", "two"))]
    for path, tuned in zip(paths, told, strict=True):
        zarr.open_group(path, mode="r+").attrs.update(tuned_on_attributes(tuned))
        write_seal(path)
    merge(paths, tmp_path / "both.zarr")
    merged = tuned_on_of_store(
        FeatureStore.open(tmp_path / "both.zarr").attrs, tmp_path / "both.zarr"
    )
    assert merged == TunedOn(train=(parts[0], parts[2]), val=(parts[1],))


def test_whole_chunks_of_the_first_are_linked(
    tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
    first = tiny_store(tmp_path, name="first", seed=1, episodes=40)  # 9,600 readings
    second = tiny_store(tmp_path, name="second", seed=2)
    merge([first, second], tmp_path / "both.zarr")
    places = [
        sorted(place.glob("sensor/values/c/*/0")) for place in (first, tmp_path / "both.zarr")
    ]
    inodes = [[path.stat().st_ino for path in paths] for paths in places]
    assert len(inodes[0]) == len(inodes[1]) == 3
    assert inodes[0][:2] == inodes[1][:2]
    assert inodes[0][2] != inodes[1][2], "holds the end of the one and the beginning of the other"
    merged = FeatureStore.open(tmp_path / "both.zarr")
    assert_holds(merged, FeatureStore.open(first))


def test_merging_again_does_nothing(
    tiny_store: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
    merge(inputs, tmp_path / "both.zarr")
    before = (tmp_path / "both.zarr").stat().st_ino
    assert merge(inputs, tmp_path / "both.zarr") is None
    assert capsys.readouterr().out.endswith("up to date, nothing to do\n")
    assert (tmp_path / "both.zarr").stat().st_ino == before


def test_merging_again_completes_a_repair(tiny_store: Make, tmp_path: Path) -> None:
    inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
    output = tmp_path / "both.zarr"
    merge(inputs, output)
    whole = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    flip(output / "vl/features/c/0/0/0", 1000)
    findings = verify(output, threads=1)
    assert begin_from_store(findings) == (120, 119)
    merge(inputs, output)
    assert {path: path.read_bytes() for path in output.rglob("*") if path.is_file()} == whole
    (output / "vl/features/c/0/0/0").unlink()
    with pytest.raises(StoreIncomplete, match=r"no such file.*stages\.verify --repair"):
        merge(inputs, output)


class TestRefusals:
    @pytest.mark.parametrize(
        ("changed", "said"),
        [
            ({"spec_digest": "another"}, r'feature spec.digest: "tiny-spec" -> "another"'),
            ({"reuse": 2}, r"vlm_reuse_count: 3 -> 2"),
            ({"sensor_channels": 4}, r'sensor.names: \[.*"sensor_4"\] -> \[.*"sensor_3"\]'),
            ({"state_dim": 3}, r'state.names: \[.*"joint_3"\] -> \[.*"joint_2"\]'),
            ({"dtype": "float16"}, r'features.dtype: "float32" -> "float16"'),
            ({"dim": 9}, r"features.row: \[3, 8\] -> \[3, 9\]"),
        ],
    )
    def test_what_differs_is_named(self, tiny_store: Make, tmp_path: Path, changed, said) -> None:
        inputs = [tiny_store(tmp_path, name="a"), tiny_store(tmp_path, name="b", **changed)]
        with pytest.raises(StoreMismatch, match=rf"(?s)a\.zarr and .*b\.zarr.*{said}"):
            merge(inputs, tmp_path / "both.zarr")
        assert not list(tmp_path.glob("both.zarr.part"))

    def test_the_sources_of_a_spec_entry_and_of_the_clock(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        inputs = [tiny_store(tmp_path, name=name) for name in "ab"]
        group = zarr.open_group(inputs[1], mode="r+")
        attrs = group.attrs.asdict()
        changed = {"digest": "x", "prompt": "{images}", "processor": {"size": [1, 2]}}
        attrs["feature_spec"] |= changed
        attrs["action_hz"] = 5.0
        group.attrs.put(attrs)
        write_seal(inputs[1])
        with pytest.raises(StoreMismatch) as caught:
            merge(inputs, tmp_path / "both.zarr")
        assert 'feature spec.prompt: "{instruction}" -> "{images}"' in str(caught.value)
        assert "action_hz: 10.0 -> 5.0" in str(caught.value)
        group.attrs.put(attrs | {"action_hz": 9.998})
        write_seal(inputs[1])
        with pytest.raises(StoreMismatch, match="cannot become one store") as caught:
            merge(inputs, tmp_path / "both.zarr")
        assert "action_hz" not in str(caught.value)

    def test_paths(self, tiny_store: Make, tmp_path: Path) -> None:
        a, b = (tiny_store(tmp_path, name=name, seed=seed) for seed, name in enumerate("ab"))
        with pytest.raises(ConfigError, match="two or more stores"):
            merge([a], tmp_path / "c.zarr")
        with pytest.raises(ConfigError, match="each named once"):
            merge([a, tmp_path / "x" / ".." / "a.zarr"], tmp_path / "c.zarr")
        for output in (a, tmp_path / "c"):
            with pytest.raises(ConfigError, match="whose name ends in"):
                merge([a, b], output)
        with pytest.raises(StoreIncomplete, match="no finished store"):
            merge([a, tmp_path / "nowhere.zarr"], tmp_path / "c.zarr")

    def test_another_store_or_build_in_its_place_is_left_alone(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
        other = tiny_store(tmp_path, name="other", seed=3)
        before = {path: path.read_bytes() for path in other.rglob("*") if path.is_file()}
        with pytest.raises(StoreMismatch, match=r"other\.zarr: expected nothing.*found another"):
            merge(inputs, other)
        build = other.rename(tmp_path / "new.zarr.part")
        with pytest.raises(StoreMismatch, match=r"new\.zarr\.part: .*found another"):
            merge(inputs, tmp_path / "new.zarr")
        build.rename(other)
        assert {path: path.read_bytes() for path in before} == before

    def test_a_build_under_way_there_is_named(self, tiny_store: Make, tmp_path: Path) -> None:
        inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
        with (
            build_lock(tmp_path / "both.zarr"),
            pytest.raises(StoreLocked, match=f"process {os.getpid()}"),
        ):
            merge(inputs, tmp_path / "both.zarr")


class TestDamage:
    @pytest.mark.parametrize("array", ["vl/features", "sensor/values", "tick/action"])
    def test_a_flipped_bit_is_never_copied(self, tiny_store: Make, tmp_path: Path, array) -> None:
        inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
        chunk = next(path for path in (inputs[1] / array / "c").rglob("*") if path.is_file())
        flip(chunk, 100)
        with pytest.raises(StoreIncomplete, match=r"(?s)2\.zarr.*stages\.verify"):
            merge(inputs, tmp_path / "both.zarr")
        assert not (tmp_path / "both.zarr").exists()

    def test_a_row_that_rots_between_check_and_copy_is_named(
        self, tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
        real = StoreBuild.finish_layout

        def rotting(self: StoreBuild, *rest) -> None:
            real(self, *rest)
            chunk = next(
                path for path in (inputs[1] / "vl/features/c").rglob("0") if path.is_file()
            )
            flip(chunk, 7 * 3 * 8 * 4)

        monkeypatch.setattr(StoreBuild, "finish_layout", rotting)
        with pytest.raises(StoreIncomplete, match=r"2\.zarr/.*: rows 7 to 7 of vl/features do not"):
            merge(inputs, tmp_path / "both.zarr")

    def test_an_input_replaced_in_the_middle_is_noticed(
        self, tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        inputs = [tiny_store(tmp_path, name=str(seed), seed=seed) for seed in (1, 2)]
        other = tiny_store(tmp_path / "other", name="2", seed=5)
        real = StoreBuild.create

        def replacing(self: StoreBuild) -> None:
            real(self)
            if other.exists():
                shutil.rmtree(inputs[1])
                other.rename(inputs[1])

        monkeypatch.setattr(StoreBuild, "create", replacing)
        with pytest.raises(StoreMismatch, match="another store took its place"):
            merge(inputs, tmp_path / "both.zarr")
        merge(inputs, tmp_path / "both.zarr")
        assert_holds(FeatureStore.open(tmp_path / "both.zarr"), FeatureStore.open(inputs[0]))


def flip(path: Path, offset: int) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)
        file.seek(offset)
        file.write(bytes([byte[0] ^ 1]))


@pytest.mark.parametrize("kill_at", [0, 23, 41, 60, 85])
def test_a_kill_at_any_write_ends_in_the_undisturbed_store(
    tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kill_at: int
) -> None:
    """`pwrite` is what every byte of a build goes through."""
    inputs = [tiny_store(tmp_path, name=str(seed), seed=seed, ticks=12) for seed in (1, 2)]
    monkeypatch.setattr("pipeline.store.merging._BLOCK_BYTES", 700)
    merge(inputs, tmp_path / "whole.zarr")
    writes, real = iter(range(10**6)), os.pwrite

    def pwrite(descriptor, block, offset):
        if next(writes) == kill_at:
            real(descriptor, bytes(block)[: len(block) // 2], offset)
            raise Killed
        return real(descriptor, block, offset)

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", pwrite)
        with pytest.raises(Killed):
            merge(inputs, tmp_path / "killed.zarr")
    assert not (tmp_path / "killed.zarr").exists()
    merge(inputs, tmp_path / "killed.zarr")
    whole, killed = (FeatureStore.open(tmp_path / f"{name}.zarr") for name in ("whole", "killed"))
    for name in ARRAY_NAMES:
        assert np.array_equal(whole.array(name), killed.array(name), equal_nan=True), name
    assert dict(whole.attrs) == dict(killed.attrs)


def test_memory_stays_bounded(tiny_store: Make, tmp_path: Path) -> None:
    """Two stores of 34 MB of sensor each are merged with less than that beyond the imports.

    Not by `ru_maxrss`: what a process is forked from counts in it.
    """
    inputs = [
        tiny_store(
            tmp_path,
            name=str(seed),
            seed=seed,
            episodes=4,
            sensor_channels=500,
            readings_a_tick=140,
        )
        for seed in (1, 2)
    ]
    code = """
import sys
from pathlib import Path
from pipeline.store import merging
from pipeline.store.merging import merge
merging._BLOCK_BYTES = 2**20
paths = [Path(each) for each in sys.argv[1:]]
def peak_kib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
before = peak_kib()
merge(paths[:2], paths[2])
print(peak_kib() - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *inputs, tmp_path / "both.zarr"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout.split()[-1]) * 1024 < 30 * 2**20

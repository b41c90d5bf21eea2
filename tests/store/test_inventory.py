"""What is in a folder of stores, and what of it may be removed."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from pipeline.base.errors import ConfigError, StoreLocked
from pipeline.base.files import REPLACED, begin_folder, mark
from pipeline.store import FeatureStore, StoreBuild, build_lock
from pipeline.store.archive import archive
from pipeline.store.chunks import note_metadata
from pipeline.store.inventory import (
    StoreEntry,
    describe_kept,
    describe_stores,
    fate_of,
    find_named,
    list_stores,
    remove_entry,
)
from pipeline.store.paths import (
    KEPT,
    STORE,
    group_attributes,
    part_path,
    previous_path,
    recover,
    set_build_aside,
)
from pipeline.store.schema import read_specs
from pipeline.store.verification import strange_files

Make = Callable[..., Path]


def hold_lock(target: Path, told: Connection) -> None:
    """Hold the lock of a store, and tell so."""
    with build_lock(target):
        told.send("held")
        time.sleep(600)


@pytest.fixture
def held(fork_server: ForkServerContext, tmp_path: Path) -> Iterator[int]:
    """Another process, of this number, holds the lock of the tiny store."""
    heard, told = fork_server.Pipe(duplex=False)
    process = fork_server.Process(target=hold_lock, args=(tmp_path / "tiny.zarr", told))
    process.start()
    assert heard.recv() == "held"
    assert process.pid is not None
    yield process.pid
    process.kill()
    process.join()


def entry(folder: Path, name: str) -> StoreEntry:
    return next(entry for entry in list_stores(folder) if entry.path.name == name)


def table(folder: Path) -> str:
    return "\n".join(describe_stores(folder, list_stores(folder), {}))


def unneeded(folder: Path) -> list[StoreEntry]:
    return [entry for entry in list_stores(folder) if fate_of(entry)[0] == "unneeded"]


def unfinish(store: Path, done: int) -> Path:
    """Make a finished store a build of which some rows are done."""
    part = store.rename(part_path(store))
    mark(part, STORE)
    build = StoreBuild(store, read_specs(part), "plan")
    rows = build.specs["vl/checksum"].shape[0]
    build.write("vl/checksum", done, build.files("vl/checksum").read(done, rows - done) * 0)
    build.close()
    attributes = group_attributes(part)
    del attributes["seal"]
    note_metadata(part, attributes)
    return part


def hold(store: Path) -> Path:
    """A copy of a store in its new build, where a killed replacement leaves it."""
    part = part_path(store)
    begin_folder(part, STORE)
    shutil.copytree(store, part / REPLACED)
    return part


class TestListing:
    def test_a_store_and_a_build(self, tiny_store: Make, tmp_path: Path) -> None:
        path = tiny_store(tmp_path)
        store = entry(tmp_path, "tiny.zarr")
        assert (store.kind, store.damage, store.done) == ("store", None, 60)
        assert store.attributes is not None
        assert store.attributes.plan == FeatureStore.open(path).attrs["plan"]
        assert store.specs["vl/features"].shape == (60, 3, 8)
        used = sum(file.stat().st_blocks * 512 for file in path.rglob("*") if file.is_file())
        assert store.bytes == used
        unfinish(path, 25)
        build = entry(tmp_path, "tiny.zarr.part")
        assert (build.kind, build.done) == ("build", 25)
        assert "25 of 60" in table(tmp_path)

    @pytest.mark.parametrize(
        ("harm", "message"),
        [
            (lambda store: (store / "zarr.json").write_text("{"), "cannot be read as JSON"),
            (lambda store: (store / "zarr.json").unlink(), "no finished store"),
            (lambda store: shutil.rmtree(store / "tick/action"), "action/zarr.json: no such file"),
            (lambda store: os.truncate(store / "vl/features/c/0/0/0", 99), "found 99"),
        ],
    )
    def test_a_damaged_store_is_listed_and_stops_nothing(
        self, tiny_store: Make, tmp_path: Path, harm, message
    ) -> None:
        harm(tiny_store(tmp_path, name="damaged"))
        tiny_store(tmp_path, name="sound")
        assert message in (entry(tmp_path, "damaged.zarr").damage or "")
        assert entry(tmp_path, "sound.zarr").damage is None
        assert "\ndamaged.zarr  damaged" in table(tmp_path)
        assert message in table(tmp_path)

    def test_an_archive(self, tiny_store: Make, tmp_path: Path) -> None:
        archive(tiny_store(tmp_path), tmp_path / "tiny.archive.zarr", level=1, threads=1)
        assert entry(tmp_path, "tiny.archive.zarr").kind == "archive"
        assert "\ntiny.archive.zarr  archive" in table(tmp_path)

    def test_asking_who_builds_does_not_stand_in_a_builders_way(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        part = unfinish(tiny_store(tmp_path), 0)
        for _ in range(2):
            with build_lock(tmp_path / "tiny.zarr"):
                assert f"being built by process {os.getpid()} on" in table(tmp_path)
            assert entry(tmp_path, part.name).holder is None

    def test_subfolders_are_searched_but_not_stores(self, tiny_store: Make, tmp_path: Path) -> None:
        inner = tiny_store(tmp_path / "deep" / "er")
        (inner / "inside.zarr").mkdir()
        assert [entry.path for entry in list_stores(tmp_path)] == [inner]
        with pytest.raises(ConfigError, match=r"stores\.folder"):
            list_stores(tmp_path / "nowhere")
        assert table(inner / "tick") == f"{inner / 'tick'}: no store in it"


class TestLeftovers:
    def test_a_finished_store_and_its_archive_are_never_among_them(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        path = tiny_store(tmp_path)
        archive(path, tmp_path / "tiny.archive.zarr", level=1, threads=1)
        os.truncate(tiny_store(tmp_path, name="bad") / "vl/features/c/0/0/0", 99)
        assert {entry.path.suffix for entry in unneeded(tmp_path)} <= {".lock"}

    def test_each_is_named_with_its_reason_and_removed(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        tiny_store(tmp_path)
        unfinish(tiny_store(tmp_path, name="none"), 0)
        (tmp_path / "new.zarr.part").mkdir()
        for name in ("gone.zarr.files.sqlite", "tiny.zarr.files.sqlite", "tiny.zarr.lock"):
            (tmp_path / name).touch()
        entries = unneeded(tmp_path)
        stopped = "a build that was stopped before any row was done"
        assert {entry.path.name: fate_of(entry)[1] for entry in entries} == {
            "gone.zarr.files.sqlite": "content digests for a store that is not there",
            "new.zarr.part": stopped,
            "none.zarr.part": stopped,
            "tiny.zarr.lock": "held by no process",
        }
        for leftover in entries:
            remove_entry(leftover, fate_of(leftover)[0])
        assert sorted(os.listdir(tmp_path)) == ["tiny.zarr", "tiny.zarr.files.sqlite"]
        assert FeatureStore.open(tmp_path / "tiny.zarr").ticks == 180

    def test_work_is_kept_unless_it_is_named(self, tiny_store: Make, tmp_path: Path) -> None:
        begun = unfinish(tiny_store(tmp_path, name="begun"), 12)
        store = tiny_store(tmp_path)
        part = hold(store)
        shutil.copytree(begun, part / ".known" / "0")
        previous = Path(shutil.copytree(store, previous_path(store)))
        mark(previous, KEPT)
        unread = Path(shutil.copytree(begun, tmp_path / "unread.zarr.part"))
        (unread / "vl" / "checksum" / "zarr.json").write_text("{")
        entries = list_stores(tmp_path)
        assert unneeded(tmp_path) == []
        lines = describe_kept(entries)
        assert lines[0] == (
            f"{begun}: unfinished build with 12 feature rows; the same command goes on, and "
            f"python -m stages.store gc {begun} --remove removes it"
        )
        assert lines[1].startswith(f"{part}: unfinished build with 72 feature rows")
        assert lines[2].startswith(f"{previous}: the store before, kept until")
        assert lines[3].startswith(f"{unread}: unfinished build that cannot be read")
        assert len(lines) == 4
        for path in (store, tmp_path / "gone.zarr.part"):
            with pytest.raises(ConfigError, match=rf"{path}: .*Nothing was removed"):
                find_named(entries, [begun, path])
        for leftover in find_named(entries, [begun, part, previous, unread]):
            remove_entry(leftover, fate_of(leftover)[0])
        assert os.listdir(tmp_path) == ["tiny.zarr"]

    def test_the_only_copy_of_a_store_is_never_removed(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        """A kill between the two renames of a replacement leaves it in `.replaced` of the part."""
        store = tiny_store(tmp_path)
        part = hold(store)
        (listed,) = find_named(list_stores(tmp_path), [part])
        fate, _ = fate_of(listed)
        shutil.rmtree(store)
        assert unneeded(tmp_path) == []
        assert "the only copy of tiny.zarr" in describe_kept(list_stores(tmp_path))[0]
        with pytest.raises(ConfigError, match="the only copy"):
            find_named(list_stores(tmp_path), [part])
        remove_entry(listed, fate)  # listed while the store was still there
        assert part.exists()

    def test_what_is_being_built_is_not_touched(
        self, tiny_store: Make, tmp_path: Path, held: int
    ) -> None:
        part = unfinish(tiny_store(tmp_path), 5)
        entries = list_stores(tmp_path)
        with pytest.raises(ConfigError, match="in use by process"):
            find_named(entries, [part])
        assert describe_kept(entries)[0].startswith(f"{part}: in use by process {held}")
        listed = replace(entry(tmp_path, part.name), holder=None)  # listed before that build began
        with pytest.raises(StoreLocked, match="not removed"):
            remove_entry(listed, fate_of(listed)[0])
        assert part.exists()

    @pytest.mark.parametrize("state", ["begun", "damaged", "sealed", "kept"])
    def test_a_removal_that_was_killed_leaves_what_the_next_build_takes(
        self, tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str
    ) -> None:
        store = tiny_store(tmp_path)
        kind = KEPT if state == "kept" else STORE
        if state == "kept":
            place = Path(shutil.copytree(store, previous_path(store)))
            mark(place, KEPT)
        elif state == "sealed":  # a kill before its last rename, when it has no marker any more
            place = store.rename(part_path(store))
        else:
            place = unfinish(store, 0)
        if state == "damaged":
            (place / "zarr.json").write_text("{")
        (leftover,) = find_named(list_stores(tmp_path), [place])

        def killed(path: Path) -> None:
            (place / "zarr.json").unlink(missing_ok=True)
            raise KeyboardInterrupt

        monkeypatch.setattr("pipeline.base.files.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            remove_entry(leftover, fate_of(leftover)[0])
        assert any(place.iterdir())
        assert kind.owns(place)

    @pytest.mark.parametrize("suffix", ["files.sqlite", "lock", "part", "previous"])
    def test_a_foreign_file_is_no_leftover(self, tmp_path: Path, suffix: str) -> None:
        foreign = tmp_path / f"gone.zarr.{suffix}"
        foreign.write_text("years of work")
        assert unneeded(tmp_path) == []
        with pytest.raises(ConfigError, match="did not write"):
            find_named(list_stores(tmp_path), [foreign])

    def test_nothing_behind_a_symbolic_link_is_touched(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        outside = unfinish(tiny_store(tmp_path / "outside"), 5)
        folder = tmp_path / "stores"
        folder.mkdir()
        (folder / "tiny.zarr.part").symlink_to(outside)
        (folder / "more").symlink_to(outside.parent)
        assert unneeded(folder) == []
        assert "a symbolic link" in describe_kept(list_stores(folder))[0]
        with pytest.raises(ConfigError, match=r"found a link to .*tiny\.zarr\.part\. Move it back"):
            recover(folder / "tiny.zarr")
        part = folder / "own.zarr.part"
        begin_folder(part, STORE)
        (part / "inside").symlink_to(outside)
        for leftover in unneeded(folder):
            remove_entry(leftover, fate_of(leftover)[0])
        assert not part.exists()
        assert (outside / "zarr.json").exists()


def test_rows_of_a_build_that_was_being_set_aside_are_removed_by_name_only(
    tiny_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill just after its metadata moved: no store is to be seen there."""
    part = unfinish(tiny_store(tmp_path), 12)

    def killed(*_: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.store.paths._move_build", killed)
        with pytest.raises(KeyboardInterrupt):
            set_build_aside(tmp_path / "tiny.zarr")
    build = entry(tmp_path, part.name)
    assert fate_of(build)[0] == "by name"
    assert not remove_entry(build, "unneeded"), "its fate is another than when it was listed"
    recover(tmp_path / "tiny.zarr")
    (line,) = describe_kept(list_stores(tmp_path))
    assert line.startswith(f"{part}: unfinished build with 12 feature rows")


def test_what_kills_left_of_replacements_goes(tiny_store: Make, tmp_path: Path) -> None:
    target = tiny_store(tmp_path)
    # The store was put back by hand after a kill had left it in the new one.
    part = hold(target)
    # Another kill while the previous store was removed, its metadata first.
    begin_folder(previous_path(target), KEPT)
    (previous_path(target) / "chunk").touch()
    recover(target)
    assert not (part / REPLACED).exists()
    assert not previous_path(target).exists()
    # A third one while the old store was removed from inside the new one.
    shutil.copytree(target, target / REPLACED)
    assert not list(strange_files(target, read_specs(target), set(target.glob("golden/**/*"))))
    (target / ".known").mkdir()
    (target / ".known" / "mine").touch()
    (strange,) = strange_files(target, read_specs(target), set(target.glob("golden/**/*")))
    assert strange.file == target / ".known" / "mine", "no marker says that it is the project's"

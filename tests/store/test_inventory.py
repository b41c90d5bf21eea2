"""What is in a folder of stores, and what of it may be removed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.errors import ConfigError, StoreLocked
from pipeline.base.files import REPLACED, begin_folder, mark
from pipeline.store import FeatureStore, StoreBuild, build_lock
from pipeline.store.archive import archive
from pipeline.store.chunks import note_metadata
from pipeline.store.inventory import (
    StoreEntry,
    describe_stores,
    is_unneeded,
    leftover,
    list_stores,
    remove_leftover,
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

Make = Callable[..., Path]


def entry(folder: Path, name: str) -> StoreEntry:
    return next(entry for entry in list_stores(folder) if entry.path.name == name)


def table(folder: Path) -> str:
    return "\n".join(describe_stores(folder, list_stores(folder), {}))


def unneeded(folder: Path) -> list[Path]:
    return [entry.path for entry in list_stores(folder) if is_unneeded(entry)]


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
        for _ in range(2):  # to look does not stand in a builder's way
            with build_lock(tmp_path / "tiny.zarr"):
                assert "being built" in table(tmp_path)
            assert "being built" not in table(tmp_path)

    @pytest.mark.parametrize(
        ("harm", "message"),
        [
            (lambda store: (store / "zarr.json").write_text("{"), "cannot be read as JSON"),
            (
                lambda store: os.truncate(store / "vl/features/c/0/0/0", 99),
                "vl/features/c/0/0/0: expected 196,612 bytes, found 99",
            ),
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

    def test_an_archive(self, tiny_store: Make, tmp_path: Path) -> None:
        archive(tiny_store(tmp_path), tmp_path / "tiny.archive.zarr", level=1, threads=1)
        assert "\ntiny.archive.zarr  archive" in table(tmp_path)

    def test_subfolders_are_searched_but_not_stores(self, tiny_store: Make, tmp_path: Path) -> None:
        inner = tiny_store(tmp_path / "deep" / "er")
        (inner / "inside.zarr").mkdir()
        assert [entry.path for entry in list_stores(tmp_path)] == [inner]
        with pytest.raises(ConfigError, match=r"stores\.folder"):
            list_stores(tmp_path / "nowhere")
        assert table(inner / "tick") == f"{inner / 'tick'}: no store in it"


class TestLeftovers:
    def test_only_builds_without_rows_are_unneeded(self, tiny_store: Make, tmp_path: Path) -> None:
        store = tiny_store(tmp_path)
        archive(store, tmp_path / "tiny.archive.zarr", level=1, threads=1)
        os.truncate(tiny_store(tmp_path, name="bad") / "vl/features/c/0/0/0", 99)
        none = unfinish(tiny_store(tmp_path, name="none"), 0)
        begun = unfinish(tiny_store(tmp_path, name="begun"), 12)
        shutil.copytree(begun, hold(store) / ".known")
        mark(Path(shutil.copytree(store, previous_path(store))), KEPT)
        unread = Path(shutil.copytree(begun, tmp_path / "unread.zarr.part"))
        (unread / "vl" / "checksum" / "zarr.json").write_text("{")
        (tmp_path / "new.zarr.part").mkdir()
        assert unneeded(tmp_path) == [tmp_path / "new.zarr.part", none]
        with build_lock(tmp_path / "none.zarr"):
            assert unneeded(tmp_path) == [tmp_path / "new.zarr.part"]
            with pytest.raises(StoreLocked, match="being built by process"):
                remove_leftover(leftover(none))
        for path in (store, tmp_path / "gone.zarr.part", tmp_path / "tiny.archive.zarr"):
            with pytest.raises(ConfigError, match=rf"{path}: .*Nothing was removed"):
                leftover(path)
        for path in (begun, part_path(store), previous_path(store), unread, none):
            remove_leftover(leftover(path))
        left = {path.name for path in tmp_path.iterdir() if path.suffix != ".lock"}
        assert left == {"tiny.zarr", "tiny.archive.zarr", "bad.zarr", "new.zarr.part"}
        assert FeatureStore.open(store).ticks == 180

    def test_the_only_copy_of_a_store_is_put_back(self, tiny_store: Make, tmp_path: Path) -> None:
        """A kill between the two renames of a replacement leaves it in `.replaced` of the part."""
        store = tiny_store(tmp_path)
        part = hold(store)
        shutil.rmtree(store)
        remove_leftover(leftover(part))
        assert not part.exists()
        assert FeatureStore.open(store).ticks == 180

    def test_a_previous_store_without_its_successor_stays(self, tiny_store: Make, tmp_path: Path):
        previous = tiny_store(tmp_path).rename(previous_path(tmp_path / "tiny.zarr"))
        mark(previous, KEPT)
        with pytest.raises(ConfigError, match="expected the store that replaced it"):
            remove_leftover(leftover(previous))
        assert previous.exists()

    @pytest.mark.parametrize("state", ["damaged", "sealed", "kept"])
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
            (place / "zarr.json").write_text("{")

        def killed(path: Path) -> None:
            (place / "zarr.json").unlink(missing_ok=True)
            raise KeyboardInterrupt

        monkeypatch.setattr("pipeline.base.files.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            remove_leftover(leftover(place))
        assert any(place.iterdir())
        assert kind.owns(place)

    @pytest.mark.parametrize("suffix", ["part", "previous"])
    def test_what_is_foreign_is_no_leftover(self, tmp_path: Path, suffix: str) -> None:
        foreign = tmp_path / f"gone.zarr.{suffix}"
        foreign.mkdir()
        (foreign / "thesis").write_text("years of work")
        assert list_stores(tmp_path) == []
        with pytest.raises(ConfigError, match="Nothing was removed"):
            leftover(foreign)

    def test_nothing_behind_a_symbolic_link_is_touched(
        self, tiny_store: Make, tmp_path: Path
    ) -> None:
        outside = unfinish(tiny_store(tmp_path / "outside"), 5)
        folder = tmp_path / "stores"
        folder.mkdir()
        (folder / "tiny.zarr.part").symlink_to(outside)
        (folder / "more").symlink_to(outside.parent)
        assert unneeded(folder) == []
        with pytest.raises(ConfigError, match=r"found a link to .*tiny\.zarr\.part\. Move it back"):
            remove_leftover(leftover(folder / "tiny.zarr.part"))
        part = folder / "own.zarr.part"
        begin_folder(part, STORE)
        (part / "inside").symlink_to(outside)
        remove_leftover(leftover(part))
        assert not part.exists()
        assert (outside / "zarr.json").exists()


def test_a_build_that_went_on_since_it_was_listed_stays(tiny_store: Make, tmp_path: Path) -> None:
    part = unfinish(tiny_store(tmp_path), 0)
    empty = leftover(part)
    assert is_unneeded(empty)
    build = StoreBuild(tmp_path / "tiny.zarr", read_specs(part), "plan")
    build.write("vl/checksum", 0, build.files("vl/checksum").read(0, 1) + 1)
    build.close()
    with pytest.raises(StoreLocked, match="went on meanwhile"):
        remove_leftover(empty)
    assert part.exists()


def test_rows_of_a_build_that_was_set_aside_count(tiny_store: Make, tmp_path: Path) -> None:
    part = unfinish(tiny_store(tmp_path), 12)
    set_build_aside(tmp_path / "tiny.zarr")
    assert entry(tmp_path, part.name).done == 12
    assert unneeded(tmp_path) == []


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

"""`stages.verify` as a user meets it: exit codes, what is said, and what to run next."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.extract.reextract import Deviation, Reextraction
from pipeline.store import part_path
from stages.command import run
from stages.verify import SHORTHANDS, main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def original(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("original"))


@pytest.fixture
def store(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "tiny.zarr"))


@pytest.fixture
def verified(store) -> Callable[..., int]:
    """`verified(...)`: the exit code of the stage on the store, with these options."""

    def call(*options: str, section: str = "verify") -> int:
        place = f"{section}.store={store}"
        params = str(ROOT / "params.yaml")
        return run("", main, ["--params", params, "--set", place, *options], SHORTHANDS)

    return call


def damage(store: Path) -> None:
    path = store / "vl/features/c/0/0/0"
    content = bytearray(path.read_bytes())
    content[17 * 3 * 8 * 4] ^= 1
    path.write_bytes(content)


def test_a_sound_store(verified, store, capsys):
    assert verified() == 0
    said = capsys.readouterr()
    assert f"{store}: checked 60 feature rows" in said.out
    assert said.out.endswith(f"{store}: sound\n")


@pytest.mark.parametrize("address", ["nonsense://here", "tcp://127.0.0.1:9", "tls://127.0.0.1:9"])
def test_an_address_where_no_scheduler_answers(verified, capsys, monkeypatch, address):
    monkeypatch.setattr("pipeline.base.scheduler.TIMEOUT_S", 0.5)
    assert verified("--set", f"verify.workers={address}") == 2
    said = capsys.readouterr().err
    assert f"verify.workers: no dask scheduler answers at {address}" in said
    assert "dask scheduler" in said and "path" not in said


def test_the_store_of_extract_where_none_is_named(verified, store, capsys):
    assert verified(section="extract") == 0
    assert f"{store}: sound" in capsys.readouterr().out


def test_a_damaged_store_says_what_is_wrong_and_what_to_run_next(verified, store, capsys):
    damage(store)
    assert verified() == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: {store}: the store is damaged:\n")
    assert "VL row 17: its bytes do not give its checksum; right/episode_001" in err
    assert f"python -m stages.verify --repair --set verify.store={store}, which" in err
    assert "which keeps what is sound, then what it says." in err


def test_repair_begins_a_build(verified, store, capsys):
    damage(store)
    assert verified("--repair") == 0
    said = capsys.readouterr().out
    assert "59 of 60 feature rows taken over, 1 to compute" in said
    assert f"run next: python -m stages.extract --set extract.store={store}, which" in said
    assert part_path(store).is_dir()
    assert verified("--repair") == 2
    assert "a repair of it has begun" in capsys.readouterr().err


def test_there_is_nothing_to_repair(verified, store, capsys):
    assert verified("--repair") == 0
    assert capsys.readouterr().out.endswith(f"{store}: sound\n")
    assert not part_path(store).exists()


def test_a_store_that_is_not_finished(verified, store, capsys):
    store.rename(part_path(store))
    assert verified() == 2
    assert "only the unfinished build" in capsys.readouterr().err


@pytest.mark.parametrize(("relative", "code"), [(1e-5, 0), (0.5, 2)])
def test_rows_computed_again(verified, store, capsys, monkeypatch, relative, code):
    def found(path, params, say):
        assert (path, params.verify.reextract) == (store, 3)
        return Reextraction((Deviation(7, relative, relative, 2, True, "here"),), 1e-3, (), ())

    monkeypatch.setattr("stages.verify.reextract", found)
    assert verified("--reextract", "3") == code
    said = capsys.readouterr()
    assert "computed 1 rows again" in said.out
    assert ("here: slot 2 deviates 5.00e-01" in said.err) is (code == 2)

"""`stages.verify` as a user meets it: exit codes, what is said, and what to run next."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.extract.engine import ExtractionReport, Speed
from pipeline.extract.row_check import Deviation, Reextraction
from pipeline.store import part_path
from stages.command import run
from stages.verify import SHORTHANDS, main

ROOT = Path(__file__).resolve().parents[2]
CPU = ("--set", "serve.device=cpu", "--set", "extract.device=cuda:7")


@pytest.fixture
def store(tiny_store, tmp_path) -> Path:
    return tiny_store(tmp_path)


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


def test_a_sound_store_has_nothing_to_repair(verified, store, capsys):
    assert verified("--repair", section="extract") == 0, "null: the store of extract"
    out = capsys.readouterr().out
    assert f"{store}: checked 60 feature rows" in out and out.endswith(f"{store}: sound\n")
    assert not part_path(store).exists()


def test_a_damaged_store_says_what_is_wrong_and_what_to_run_next(verified, store, capsys):
    damage(store)
    assert verified() == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: {store}: the store is damaged:\n")
    assert "row 17 of vl/features does not give its checksum" in err
    assert f"python -m stages.verify --repair --set verify.store={store} --params " in err


def test_repair_makes_the_store_again(verified, store, capsys, monkeypatch):
    damage(store)

    def extract(params, say, repair):
        assert (params.extract.store, params.extract.plan, repair) == (store, False, True)
        return ExtractionReport(60, 59, 1, 0, 1.0, Speed())

    monkeypatch.setattr("pipeline.extract.run.extract", extract)
    assert verified("--repair", "--set", "extract.plan=true") == 0
    said = capsys.readouterr().out
    assert f"{store}: repaired: 60 rows, 1 computed (1.0 rows/s), 59 taken over" in said


@pytest.mark.parametrize(("relative", "code"), [(1e-5, 0), (0.5, 2)])
def test_rows_computed_again(verified, store, capsys, monkeypatch, relative, code):
    def found(path, params, say):
        assert (path, params.verify.reextract) == (store, 3)
        return Reextraction((Deviation(7, relative, 2, True, "here"),), 1e-3, (), ())

    monkeypatch.setattr("pipeline.extract.row_check.reextract", found)
    assert verified("--reextract", "3") == code
    said = capsys.readouterr()
    assert "computed 1 rows again" in said.out
    assert ("here: slot 2 deviates 5.00e-01" in said.err) is (code == 2)


class TestCheckpoint:
    """What the proof itself finds is tested with it."""

    @pytest.fixture
    def proved(self, tmp_path, monkeypatch) -> list[tuple]:
        """What was loaded and proved; a policy lies at `tmp_path / "head"`."""
        (tmp_path / "head" / "best").mkdir(parents=True)
        (tmp_path / "head" / "best" / "policy.json").write_text("{}")
        calls: list[tuple] = []
        spec = {"digest": "x"}
        held = SimpleNamespace(source={"feature_spec": spec}, golden=(1, 2), step=9, basis=None)
        held.encoders = {"features": 1}
        held.policy = lambda: held

        def prove(checkpoint, features, say):
            calls.append((checkpoint, features))
            say("2 golden rows computed again")

        monkeypatch.setattr("pipeline.policy.checkpoint.load_policy", lambda folder: held)
        monkeypatch.setattr("pipeline.robot.live_features.LiveFeatures", lambda *given: given)
        monkeypatch.setattr("pipeline.robot.live_features.prove", prove)
        return calls

    def test_the_one_that_is_named(self, verified, proved, tmp_path, capsys):
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "policy.json").write_text("{}")
        assert verified("--checkpoint", str(tmp_path / "other"), *CPU) == 0
        said = capsys.readouterr().out
        assert said.splitlines() == [
            f"{tmp_path / 'other'} (step 9): 2 golden rows, cpu",
            "2 golden rows computed again",
        ]
        ((checkpoint, (vlm, spec, device, _)),) = proved
        assert (spec, device) == (checkpoint.source["feature_spec"], "cpu")
        assert vlm.image_resize_height == 112

    def test_that_of_train_head_where_none_is_named(self, verified, proved, tmp_path, capsys):
        place = f"train_head.output={tmp_path / 'head'}"
        assert verified("--set", place, *CPU, "--checkpoint") == 0
        assert f"{tmp_path / 'head/best'} (step 9)" in capsys.readouterr().out
        assert len(proved) == 1

    def test_a_policy_that_looks_at_no_features_has_nothing_to_prove(
        self, verified, proved, tmp_path, capsys, monkeypatch
    ):
        held = SimpleNamespace(source={"feature_spec": {}}, golden=(), step=9)
        held.policy = lambda: SimpleNamespace(encoders={"state": 1})
        monkeypatch.setattr("pipeline.policy.checkpoint.load_policy", lambda folder: held)
        assert verified("--checkpoint", str(tmp_path / "head"), *CPU) == 0
        assert "looks at no features, so nothing is to be proved" in capsys.readouterr().out
        assert proved == []

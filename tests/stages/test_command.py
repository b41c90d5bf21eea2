"""Exit codes and messages that every stage shares."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import RecordingError
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]
PARAMS = str(ROOT / "params.yaml")


def test_zero_when_done(capsys):
    seen = []
    assert run("Summary.", seen.append, ["--params", PARAMS, "--set", "data.action_hz=5"]) == 0
    assert seen[0].data.action_hz == 5


def test_two_and_one_message_for_what_the_user_can_mend(capsys):
    def work(params):
        raise RecordingError("folder/x.npz: truncated")

    assert run("Summary.", work, ["--params", PARAMS]) == 2
    assert capsys.readouterr().err == "error: folder/x.npz: truncated\n"


def test_two_for_a_place_that_cannot_be_used(capsys, tmp_path):
    (tmp_path / "file").touch()

    def work(params):
        (tmp_path / "file" / "below").mkdir()

    assert run("Summary.", work, ["--params", PARAMS]) == 2
    assert f"error: {tmp_path}/file/below: Not a directory" in capsys.readouterr().err


def test_two_for_bad_params(capsys):
    assert run("Summary.", print, ["--params", PARAMS, "--set", "nothing.like=it"]) == 2
    assert "nothing: Extra inputs are not permitted" in capsys.readouterr().err


def test_a_bug_keeps_its_traceback():
    def work(params):
        raise KeyError("bug")

    with pytest.raises(KeyError):
        run("Summary.", work, ["--params", PARAMS])


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_one_and_a_word_when_stopped(capsys, sent):
    def work(params):
        os.kill(os.getpid(), sent)
        signal.pause()

    before = signal.getsignal(signal.SIGTERM)
    try:
        assert run("Summary.", work, ["--params", PARAMS]) == 1
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "the same command continues from here" in capsys.readouterr().err


@pytest.mark.parametrize("stage", ["demo", "extract", "train_head", "evaluate"])
def test_help_explains_each_stage_from_any_folder(stage, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", f"stages.{stage}", "--help"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert "--set section.key=value" in done.stdout
    assert len(done.stdout.split()) > 30

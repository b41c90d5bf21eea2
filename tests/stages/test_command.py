"""Exit codes and messages that every stage shares."""

import os
import re
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import stages.__main__
from pipeline.base.errors import RecordingError
from pipeline.base.printed_commands import command as advised
from stages import command
from stages.command import Shorthand, run, short

ROOT = Path(__file__).resolve().parents[2]
PARAMS = str(ROOT / "params.yaml")


def test_two_and_one_message_for_what_the_user_can_mend(capfd, tmp_path):
    (tmp_path / "file").touch()

    def bad(params):
        raise RecordingError("folder/x.npz: truncated")

    def below_a_file(params):
        (tmp_path / "file" / "below").mkdir()

    def broken(params):
        raise BrokenPipeError(32, "Broken pipe")

    for work, said in (
        (bad, "error: folder/x.npz: truncated\n"),
        (below_a_file, f"error: {tmp_path}/file/below: Not a directory"),
        (broken, "Broken pipe"),
    ):
        assert run("Summary.", work, ["--params", PARAMS]) == 2
        assert said in capfd.readouterr().err


def test_two_for_bad_params_and_a_misspelt_key_is_recognised(capsys):
    wrong = [
        "nothing.like=it",
        "train_head.expert.layer=2",
        "data.sources=[{name: a, paths: x}, {name: b}]",
    ]
    options = [word for override in wrong for word in ("--set", override)]
    assert run("Summary.", print, ["--params", PARAMS, *options]) == 2
    err = capsys.readouterr().err
    assert "nothing: unknown key; --keys lists" in err
    assert "train_head.expert.layer: unknown key; --keys lists" in err
    assert "data.sources.0.paths: unknown key; --keys lists" in err
    assert "data.sources.1: expected either path or hub, found neither" in err


SHORTHANDS = (
    Shorthand("--repair", "verify.repair", "mend"),
    Shorthand("--reextract", "verify.reextract", "rows", "N"),
    Shorthand("inputs", "stores.inputs", "stores", "STORE", nargs="*"),
)


def test_shorthands_stand_for_a_set(capsys):
    seen = []
    arguments = ["--params", PARAMS, "--repair", "--reextract", "8", "a b.zarr", "c,d.zarr"]
    arguments += ["--set", "data.action_hz=5"]
    assert run("Summary.", seen.append, arguments, SHORTHANDS) == 0
    assert seen[0].verify.repair is True
    assert seen[0].verify.reextract == 8
    assert seen[0].stores.inputs == (Path("a b.zarr"), Path("c,d.zarr"))
    assert seen[0].data.action_hz == 5
    assert run("Summary.", print, ["--params", PARAMS, "--reextract", "-1"], SHORTHANDS) == 2
    assert "verify.reextract: expected greater" in capsys.readouterr().err


def test_short_options_set_keys_and_are_repeated_in_what_a_message_advises():
    seen = []

    def work(params):
        seen.append((params.train_head.lr, params.data.views, advised("evaluate")))

    options = (*short("train_head", "--lr", "--steps"), *short("data", "--views"))
    arguments = ["--params", PARAMS, "--lr", "1e-3", "--steps", "8", "--views", "View1", "View2"]
    assert run("Summary.", work, arguments, options) == 0
    ((lr, views, printed),) = seen
    assert (lr, views) == (1e-3, ("View1", "View2"))
    assert "--set train_head.lr=1e-3" in printed and "train_head.max_steps=8" in printed
    assert "data.views" in printed


@pytest.mark.parametrize("folder", ["2026", "1e3", "null", "yes", "2026-11-26", "a b", "plain"])
def test_a_folder_stays_text_whatever_yaml_would_read(folder):
    seen = []
    options = short("train_head", "--out")
    assert run("Summary.", seen.append, ["--params", PARAMS, "--out", folder], options) == 0
    assert seen[0].train_head.output == Path(folder)


def test_keys_are_listed_with_defaults_and_meaning(capsys):
    assert run("Summary.", print, ["--keys"], sections=("verify", "train_head")) == 0
    out = capsys.readouterr().out
    assert "verify: What is checked in a store." in out
    assert "  verify.reextract = 0\n      Number of random rows to compute again" in out
    assert '  train_head.output = "models/head"\n' in out
    assert "extract.store" not in out.replace("`extract.store`", "")
    assert run("Summary.", print, ["--keys"]) == 0
    assert "  vlm.checkpoint = (has to be given)" in capsys.readouterr().out


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

    before = signal.getsignal(sent)
    assert run("Summary.", work, ["--params", PARAMS]) == 1
    assert signal.getsignal(sent) is before
    assert "run the same command again" in capsys.readouterr().err


def in_a_process(arguments, stdout, folder):
    """Exit code and stderr of a Python of its own, started in this folder."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return done.returncode, done.stderr


@pytest.fixture
def nobody():
    """The end to write to of a pipe from which nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


def test_keys_for_a_reader_that_has_gone(nobody, tmp_path):
    """Such as `| head -1`."""
    assert in_a_process(["-m", "stages.train_head", "--keys"], nobody, tmp_path) == (0, "")


WORK = """
import sys
from stages.command import run
raise SystemExit(run("", {work}, ["--params", {params!r}]))
"""


def test_one_and_no_word_where_nobody_reads_what_work_prints(nobody, tmp_path):
    code = WORK.format(work="lambda params: print('x' * 100_000)", params=PARAMS)
    assert in_a_process(["-c", code], nobody, tmp_path) == (1, "")


@pytest.mark.parametrize(("module", "sent"), [("yaml", "SIGINT"), ("torch", "SIGTERM")])
def test_one_and_a_word_when_stopped_while_it_imports(tmp_path, module, sent):
    """Of its own options, and of its work."""
    (tmp_path / f"{module}.py").write_text(
        f"import os, signal\nos.kill(os.getpid(), signal.{sent})\n"
    )
    arguments = ["-m", "stages.demo", "--params", PARAMS]
    ended = in_a_process(arguments, subprocess.DEVNULL, tmp_path)
    assert ended == (1, "stopped; run the same command again\n")


STAGES = sorted(path.stem for path in ROOT.glob("stages/[a-z]*.py") if path.stem != "command")


HELP = """
import runpy, sys
for stage in {stages}:
    sys.argv = [stage, "--help"]
    try:
        runpy.run_module(f"stages.{{stage}}", run_name="__main__")
    except SystemExit as ended:
        assert ended.code == 0, stage
"""


def test_help_explains_each_stage_from_any_folder_at_once(tmp_path):
    """Nothing that takes seconds to import is imported for it."""
    for heavy in ("torch", "zarr", "matplotlib", "transformers", "pydantic", "numpy"):
        # The working directory is the first place that `python -c` imports from.
        (tmp_path / f"{heavy}.py").write_text("raise ImportError(__name__)")
    with (tmp_path / "help.txt").open("w") as out:
        assert in_a_process(["-c", HELP.format(stages=STAGES)], out, tmp_path) == (0, "")
    for text in (tmp_path / "help.txt").read_text().split("usage: ")[1:]:
        assert "--set section.key=value" in text and len(text.split()) > 30


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_is_a_module_and_a_subcommand_with_the_same_options(stage, monkeypatch):
    given = []
    monkeypatch.setattr(command, "run", lambda *parts, **named: given.append((parts, named)))
    with pytest.raises(SystemExit):
        runpy.run_path(str(ROOT / f"stages/{stage}.py"), run_name="__main__")
    monkeypatch.setattr(stages.__main__, "run", command.run)
    stages.__main__.main([stage, "--keys"])
    ((summary, _), named), ((same, work, typed, shorthands, sections, prog), _) = given
    assert summary == same and work.__module__ == f"stages.{stage}" and typed == ["--keys"]
    assert named["sections"] == sections and named.get("shorthands", ()) == shorthands
    assert prog == f"vla-cache {stage}"


def test_all_commands_are_listed_and_completed(capsys):
    assert stages.__main__.main([]) == 0
    listed = capsys.readouterr().out
    assert sorted(re.findall(r"^  (\w+) +[A-Z]", listed, re.MULTILINE)) == STAGES
    assert stages.__main__.main(["--completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert f"subparsers=({' '.join(sum(stages.__main__.COMMANDS.values(), ()))})" in script
    assert "verify_option_strings=(-h --help --params --set --keys --reextract" in script

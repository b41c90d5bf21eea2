"""The commands of the walkthrough run in their order, on a few recordings.

Lines of a block that begin with `$` are commands, the others are what they print, shortened.
`serve` and the arm beside it wait for each other: `tests/robot/test_examples.py` has them.
"""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml

import stages.demo
from pipeline.base.config import load_params
from stages.__main__ import main

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "walkthrough.md"
BLOCK = re.compile(r"^```(?P<kind>yaml)?\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
STARTED_ELSEWHERE = ("stages.serve", "simulated_arm.py")
OF_MANY_STEPS = ("step 50:", "step 450:", "linear fit ", "chunk +")
"""Printed lines that need more than a few steps, or that the page has wrapped."""


@pytest.fixture
def repro(tmp_path, monkeypatch):
    """A folder after `dvc repro`, as far as the walkthrough uses it; a few steps of training."""
    document = yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))
    document["demo"]["episodes"] = 6
    document["train_head"] |= {"max_steps": 2, "eval_every": 2, "warmup_steps": 1}
    document["train_head"] |= {"batch_size": 8, "split": {"folds": 3}}  # two test groups
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    stages.demo.main(load_params(Path("params.yaml")))
    return tmp_path


def commands(text: str) -> list[tuple[str, list[str]]]:
    """Each command of a block, with the words that begin the lines which it prints."""
    listed: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line.startswith("$ "):
            listed.append((line[2:], []))
        elif listed and not line.startswith(OF_MANY_STEPS):
            listed[-1][1].append(" ".join(re.split(r"[\d…:(]", line)[0].split()))
    return listed


@pytest.mark.slow  # 50 s
def test_the_walkthrough_goes_the_whole_way(repro, monkeypatch, capsys):
    first, settings, *rest = BLOCK.finditer(PAGE.read_text(encoding="utf-8"))
    subprocess.run(["bash", "-ec", first["text"]], cwd=repro, check=True)
    monkeypatch.chdir(repro / "walk")
    document = yaml.safe_load(Path("params.yaml").read_text(encoding="utf-8"))
    for section, values in yaml.safe_load(settings["text"]).items():
        document[section] |= values
    Path("params.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    ran = []
    for command, expected in (entry for block in rest for entry in commands(block["text"])):
        python, *words = shlex.split(command)
        if any(name in command for name in STARTED_ELSEWHERE):
            continue
        assert (python, words[0]) == ("python", "-m"), command
        few = ["--set", "rollout.episodes=2"] if "rollout" in command else []
        capsys.readouterr()
        code = main([words[1].removeprefix("stages."), *words[2:], *few])
        out, err = capsys.readouterr()
        assert code == 0, f"{command}\n{out}{err}"
        printed = [" ".join(line.split()) for line in (out + err).splitlines()]
        missing = [start for start in expected if not any(p.startswith(start) for p in printed)]
        assert not missing, f"{command} no longer prints {missing}:\n{out}"
        ran.append(words[1])
    assert {"stages.doctor", "stages.extract", "stages.train_head", "stages.rollout"} <= {*ran}

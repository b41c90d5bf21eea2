"""The command refuses a checkpoint and a store that do not belong together."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.store.archive import archive
from stages import evaluate, train_head
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]
PICTURES = (
    "curves",
    "dimension_horizon",
    "dimensions",
    "episode_worst",
    "episodes",
    "horizon",
    "modalities",
    "scatter",
    "timeline",
)
"""Of one held-out episode, which is the worst, and of which dvc.yaml lists some."""


@pytest.fixture(scope="module")
def trained(
    quick_params: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A params.yaml whose head is trained."""
    folder = tmp_path_factory.mktemp("evaluate")
    judged = {"checkpoint": str(folder / "head"), "output": str(folder / "report")}
    document = quick_params(folder) | {"evaluate": judged}
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    assert run("", train_head.main, ["--params", str(path)]) == 0
    return path


def test_a_store_that_grew_is_judged_on_the_same_episodes(
    trained: Path,
    tiny_store: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    grown = tiny_store(tmp_path, episodes=9)
    for store in (trained.parent / "tiny.zarr", grown):
        assert (
            run("", evaluate.main, ["--params", str(trained), "--set", f"evaluate.store={store}"])
            == 0
        )
        assert "30 held-out ticks of 1 episode(s)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("store", "said"),
    [
        ({"spec_digest": "other"}, 'feature_spec.digest: "tiny-spec" (the checkpoint), "other"'),
        ({"sensor_channels": 7}, "streams.sensor.names"),
        ({"state_dim": 0}, "streams.state.names"),
        ({"reuse": 2}, "vlm_reuse_count: 3 (the checkpoint), 2 (the store)"),
        ({"episodes": 1}, "lacks 1 of the 1 episodes"),
        ({"seed": 1}, "other recordings under the names of 1 of the 1 held-out episodes"),
    ],
)
def test_another_store_is_refused_by_name(
    trained: Path,
    tiny_store: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    store: dict[str, object],
    said: str,
) -> None:
    other = tiny_store(tmp_path, name="other", **store)
    assert (
        run("", evaluate.main, ["--params", str(trained), "--set", f"evaluate.store={other}"]) == 2
    )
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


@pytest.mark.parametrize("array", ["sensor/values", "vl/features"])
def test_a_flipped_bit_is_refused_where_it_would_be_judged_on(
    trained: Path,
    tiny_store: Callable[..., Path],
    flip: Callable[[Path, str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    array: str,
) -> None:
    store = tiny_store(tmp_path, name="flipped")
    file = flip(store, array)
    arguments = ["--params", str(trained), "--set", f"evaluate.store={store}"]
    arguments += ["--set", f"evaluate.output={tmp_path / 'report'}"]
    assert run("", evaluate.main, arguments) == 2
    assert f"{file}: " in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
    assert run("", evaluate.main, [*arguments, "--set", "train_head.check_store=false"]) == 0


def test_a_missing_checkpoint_says_what_to_run(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = f"evaluate.checkpoint={tmp_path / 'nowhere'}"
    assert run("", evaluate.main, ["--params", str(trained), "--set", wanted]) == 2
    assert "Run stages.train_head" in capsys.readouterr().err


def test_last_can_be_judged_too(trained: Path) -> None:
    last = f"evaluate.checkpoint={trained.parent / 'head/last'}"
    assert run("", evaluate.main, ["--params", str(trained), "--set", last]) == 0


def test_the_report_says_what_was_judged_and_which_streams_are_used(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One held-out episode: nothing can be shuffled, and the report says so."""
    arguments = ["--params", str(trained), "--set", f"evaluate.output={tmp_path / 'report'}"]
    assert run("", evaluate.main, arguments) == 0
    said = capsys.readouterr().out
    assert "sensor    zeroed" in said
    assert "sensor shuffled: not judged" in said
    for name in PICTURES:
        assert (tmp_path / f"report/{name}.png").read_bytes().startswith(b"\x89PNG")
    streams = (tmp_path / "report/streams.csv").read_text()
    assert "\nsensor delayed 50 ms," in streams
    judged = json.loads((tmp_path / "report/judged.json").read_text())
    assert judged["policy"]["model_type"] == "regression"
    assert judged["policy"]["samples"] == 1
    assert judged["drawn"] is None
    ((name, held_out),) = judged["on"]["held_out"].items()
    assert held_out["ticks"] == [0, 30]
    page = (tmp_path / "report/report.html").read_text()
    place = f"data/demo/recordings/{name.split('/')[1]}"
    assert f"No frames: there is no recording at {place} any more." in page


def test_the_same_judgement_is_the_same_bytes_wherever_it_is_written(
    trained: Path, tmp_path: Path
) -> None:
    written = []
    for output in (tmp_path / "one", tmp_path / "else/where"):
        arguments = ["--params", str(trained), "--set", f"evaluate.output={output}"]
        assert run("", evaluate.main, arguments) == 0
        written.append({file.name: file.read_bytes() for file in output.iterdir()})
    assert written[0] == written[1]
    assert "report.html" in written[0]


def test_a_report_says_that_the_logs_are_gone(trained: Path, tmp_path: Path) -> None:
    logs = shutil.move(trained.parent / "logs", tmp_path / "logs")
    arguments = ["--params", str(trained), "--set", f"evaluate.output={tmp_path / 'report'}"]
    try:
        assert run("", evaluate.main, arguments) == 0
    finally:
        shutil.move(logs, trained.parent / "logs")
    assert (
        f"there are none in {trained.parent / 'logs/plots/metrics'} any more"
        in (tmp_path / "report/report.html").read_text()
    )
    assert not (tmp_path / "report/curves.png").exists()


def test_dvc_misses_no_file_of_a_single_episode(trained: Path, tmp_path: Path) -> None:
    """Nor of one whose streams nobody asked for."""
    listed = re.findall(r"evaluate\.output}/([\w.]+)", (ROOT / "dvc.yaml").read_text())
    arguments = ["--set", f"evaluate.output={tmp_path}", "--set", "evaluate.modalities=false"]
    assert run("", evaluate.main, ["--params", str(trained), *arguments]) == 0
    assert len(listed) > 8 and set(listed) <= {file.name for file in tmp_path.iterdir()}


def test_streams_are_left_alone_where_nobody_asks(trained: Path, tmp_path: Path) -> None:
    output = tmp_path / "report"
    arguments = ["--set", f"evaluate.output={output}", "--set", "evaluate.modalities=false"]
    assert run("", evaluate.main, ["--params", str(trained), *arguments]) == 0
    assert not (output / "modalities.png").exists()
    assert (output / "streams.csv").read_text() == "spoilt,times_intact,overall_error\n"


def test_a_sampling_policy_is_judged_on_the_mean_of_samples(trained: Path, tmp_path: Path) -> None:
    head = tmp_path / "head"
    own = [
        "train_head.model_type=flow_matching",
        f"train_head.output={head}",
        f"train_head.logs={tmp_path / 'logs'}",
        f"evaluate.checkpoint={head}",
        "evaluate.modalities=false",
    ]
    arguments = ["--params", str(trained), *(part for one in own for part in ("--set", one))]
    assert run("", train_head.main, arguments) == 0
    errors = []
    for samples in (1, 8, 8):
        output = tmp_path / f"report{len(errors)}"
        more = ["--set", f"evaluate.samples={samples}", "--set", f"evaluate.output={output}"]
        assert run("", evaluate.main, [*arguments, *more]) == 0
        judged = json.loads((output / "judged.json").read_text())
        assert judged["policy"]["samples"] == samples
        assert judged["drawn"] == {"samples": samples, "batch_size": 64}
        errors.append(json.loads((output / "metrics.json").read_text())["overall"]["policy"])
    assert errors[1] == errors[2] != errors[0]


def test_an_archive_does_what_its_store_does(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packed = tmp_path / "tiny.archive.zarr"
    archive(trained.parent / "tiny.zarr", packed, level=1, threads=1)
    arguments = ["--params", str(trained), "--set", f"train_head.scratch={tmp_path / 'scratch'}"]
    from_store, from_archive = tmp_path / "from_store", tmp_path / "from_archive"
    told = [*arguments, "--set", f"evaluate.output={from_store}"]
    assert run("", evaluate.main, told) == 0
    archived = [*arguments, "--set", f"extract.store={packed}"]
    assert run("", train_head.main, archived) == 0
    said = capsys.readouterr().out
    assert "feed: compressed" in said and "nothing to do" in said
    assert run("", evaluate.main, [*archived, "--set", f"evaluate.output={from_archive}"]) == 0
    assert (from_archive / "metrics.json").read_bytes() == (
        from_store / "metrics.json"
    ).read_bytes()

"""The command refuses a checkpoint and a store that do not belong together."""

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from stages import evaluate, train_head
from stages.command import run


@pytest.fixture(scope="module")
def trained(tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A params.yaml whose head is trained."""
    folder = tmp_path_factory.mktemp("evaluate")
    document = {
        "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
        "vlm": {"checkpoint": "unused"},
        "extract": {"store": str(tiny_store(folder))},
        "train_head": {
            "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
            "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
            "expert": {"dim": 8, "layers": 1, "heads": 1},
            "batch_size": 8,
            "max_steps": 3,
            "sensor_window": 6,
            "state_window": 5,
            "device": "cpu",
            "output": str(folder / "head"),
            "logs": str(folder / "logs"),
        },
        "evaluate": {"checkpoint": str(folder / "head"), "output": str(folder / "report")},
    }
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


def test_a_missing_checkpoint_says_what_to_run(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = f"evaluate.checkpoint={tmp_path / 'nowhere'}"
    assert run("", evaluate.main, ["--params", str(trained), "--set", wanted]) == 2
    assert "Run stages.train_head" in capsys.readouterr().err


def test_last_can_be_judged_too(trained: Path) -> None:
    last = f"evaluate.checkpoint={trained.parent / 'head/last'}"
    assert run("", evaluate.main, ["--params", str(trained), "--set", last]) == 0

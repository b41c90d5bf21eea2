"""The recorder of Meta-World's demonstrations."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from experiments.metaworld.recording import Record, demonstrate, record, seeds_of
from pipeline.base.config import Source
from pipeline.base.errors import ConfigError
from pipeline.data import open_recordings
from pipeline.simulation.meta_world import HZ, VIEW, instruction_of

needs_meta_world = pytest.mark.skipif(
    find_spec("metaworld") is None, reason="needs the extra `metaworld`"
)


def test_no_two_purposes_or_runs_share_an_episode() -> None:
    ranges = [
        seeds_of(purpose, run)
        for purpose in ("demonstrations", "validation", "evaluation")
        for run in (0, 1, 99)
    ]
    assert len(set().union(*ranges)) == sum(map(len, ranges)) > 0
    with pytest.raises(ConfigError, match="0 to 99, found 100"):
        seeds_of("validation", 100)


@needs_meta_world
@pytest.mark.extra
def test_a_set_is_what_the_expert_did_and_is_recorded_once(tmp_path: Path) -> None:
    asked = Record(task="button-press-topdown-v3", run=0, episodes=2, image=48, shadows=False)
    (kept,) = record(tmp_path, [asked], jobs=1)
    assert len(kept.seeds) == 2 and {*kept.seeds} <= {*seeds_of("demonstrations", 0)}
    folder = tmp_path / asked.task
    opened = open_recordings([Source(name="s", path=str(folder))]).recordings
    assert len(opened) == 2
    _, truth = demonstrate(asked, kept.seeds[0])
    assert truth is not None
    first = opened[0]
    action, state = first.action(), first.state()
    assert state is not None and action is not None and action.kind == "delta"
    np.testing.assert_array_equal(action.values, truth.columns["action"])
    np.testing.assert_array_equal(state.values, truth.columns["observation.state"])
    assert np.allclose(np.diff(state.time), 1 / HZ, atol=1e-6)
    assert first.instruction == instruction_of(asked.task)
    camera = first.cameras()[VIEW]
    film = truth.films[f"observation.images.{VIEW}"]
    assert len(camera.time) == len(film)
    before = (folder / "meta" / "info.json").stat().st_mtime_ns
    assert record(tmp_path, [asked], jobs=1) == [kept]
    assert (folder / "meta" / "info.json").stat().st_mtime_ns == before
    other = asked.model_copy(update={"episodes": 3})
    with pytest.raises(ConfigError, match=r"record.json: .*episodes 2"):
        record(tmp_path, [other], jobs=1)

"""One simulated episode as an inspection sees it, and the clocks of it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.base.config import Source
from pipeline.data import Channels, Stream, open_recordings
from pipeline.data.timeline import build_timeline
from pipeline.look.page.style import RC
from pipeline.look.recording.facts import Clock, EpisodeView, Gap
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode


@pytest.fixture(autouse=True)
def common_style() -> Iterator[None]:
    """As the page draws them."""
    with mpl.rc_context(RC):
        yield


@pytest.fixture(scope="session")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one raw episode of three views, whose robot's clock has a gap."""
    root = tmp_path_factory.mktemp("raw")
    write_raw(root / "Red_point", simulate_episode(1, 1.767e9))
    return root


@pytest.fixture(scope="session")
def view(raw: Path) -> EpisodeView:
    """That episode, read."""
    (one,) = open_recordings([Source(name="demo", path=(str(raw),))]).recordings
    sensor, state, poses = one.sensor(), one.state(), one.poses()
    assert sensor is not None
    assert state is not None
    assert poses is not None
    line = build_timeline(one, 10.0, 3, "rotvec", state, sensor)
    cameras = one.cameras()
    streams = (*cameras.values(), sensor, state)
    zero = min(float(stream.time[0]) for stream in streams)
    return EpisodeView(one, line, cameras, sensor, state, poses, None, (), zero)


def clock(name: str, kind: Any, time: np.ndarray, gaps: tuple[Gap, ...] = ()) -> Clock:
    """A clock without jitter."""
    return Clock(name, kind, time, 1 / float(np.median(np.diff(time))), 0.0, gaps)


@pytest.fixture
def clocks(view: EpisodeView) -> tuple[Clock, ...]:
    """All of the episode's, the poses' the same as the state's, and the gap in them."""
    assert view.timeline is not None
    assert view.state is not None
    assert view.sensor is not None
    time = view.state.time
    wide = np.flatnonzero(np.diff(time) > 0.04).tolist()
    gaps = tuple(Gap(float(time[at]), float(time[at + 1])) for at in wide)
    return (
        *(clock(name, "camera", camera.time) for name, camera in view.cameras.items()),
        clock("sensor", "stream", view.sensor.time),
        clock("state", "stream", time, gaps),
        clock("poses", "stream", time, gaps),
        clock("ticks", "tick", view.timeline.time),
        clock("VL rows", "vl_row", view.timeline.vl_time),
    )


@pytest.fixture
def felt(view: EpisodeView) -> Callable[..., EpisodeView]:
    """`felt(names, units, time, values)`: the episode with this sensor, beginning at time 0."""

    def build(names: Any, units: Any, time: np.ndarray, values: np.ndarray) -> EpisodeView:
        stream = Stream(Channels(tuple(names), tuple(units)), time, values.astype(np.float32))
        return replace(view, sensor=stream, zero=0.0)

    return build


@pytest.fixture
def words_of() -> Callable[[Figure], str]:
    """All that is written in a figure."""

    def words(figure: Figure) -> str:
        figure.draw_without_rendering()
        texts = figure.findobj(lambda one: hasattr(one, "get_text"))
        return "\n".join(text.get_text() for text in texts)  # type: ignore[attr-defined]

    return words

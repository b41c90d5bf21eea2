"""Everything that looks wrong in one episode."""

from collections.abc import Iterator

from pipeline.base.errors import RecordingError
from pipeline.data.recording import Nominal
from pipeline.look.recording.channel_flaws import channel_flaws
from pipeline.look.recording.clock_flaws import clock_flaws
from pipeline.look.recording.count_flaws import count_flaws
from pipeline.look.recording.facts import EpisodeView, Flaw
from pipeline.look.recording.pixel_flaws import pixel_flaws


def find_flaws(view: EpisodeView) -> tuple[Flaw, ...]:
    """The flaws of this episode, those of reading it included: errors first, then by time.

    Each kind's rule and thresholds stand in `clock_flaws`, `count_flaws`, `channel_flaws` and
    `pixel_flaws`; which frames are decoded, in the last. Most rules look for what is unlike the
    rest of the same episode, so that no expectation about the robot is needed.
    """
    found = [*view.flaws, *_said(view), *channel_flaws(view), *pixel_flaws(view)]
    return tuple(sorted(found, key=_order))


def _said(view: EpisodeView) -> Iterator[Flaw]:
    """What is unlike what the recording says of itself, and what clocks show without that."""
    try:
        said = view.recording.nominal()
    except RecordingError as error:
        said = Nominal()
        # What keeps a stream from being read, too, has been told with it.
        if str(error) not in {flaw.message for flaw in view.flaws}:
            yield view.flaw("unreadable", "metadata", str(error))
    for mistake in said.mistakes:
        yield view.flaw("wrong metadata", "episode", mistake)
    yield from clock_flaws(view, said)
    yield from count_flaws(view, said)


def _order(flaw: Flaw) -> tuple[bool, float]:
    return flaw.severity != "error", float("-inf") if flaw.start_s is None else flaw.start_s

"""Everything that looks wrong in one episode."""

from pipeline.inspection.channel_flaws import channel_flaws
from pipeline.inspection.clock_flaws import clock_flaws
from pipeline.inspection.facts import EpisodeView, Flaw
from pipeline.inspection.pixel_flaws import pixel_flaws


def find_flaws(view: EpisodeView) -> tuple[Flaw, ...]:
    """The flaws of this episode, those of reading it included: errors first, then by time.

    Each kind's rule and thresholds stand in `clock_flaws`, `channel_flaws` and `pixel_flaws`; which
    frames are decoded, in the last. Most rules look for what is unlike the rest of the same
    episode, so that no expectation about the robot is needed.
    """
    found = [*view.flaws, *clock_flaws(view), *channel_flaws(view), *pixel_flaws(view)]
    return tuple(sorted(found, key=_order))


def _order(flaw: Flaw) -> tuple[bool, float]:
    return flaw.severity != "error", float("-inf") if flaw.start_s is None else flaw.start_s

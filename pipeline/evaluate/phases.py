"""The phase of each tick, by the force: approach, contact, hold.

No format marks phases itself; `pipeline.data.contact` decides what is contact.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import action_groups
from pipeline.data.contact import contact_spans, force_columns
from pipeline.store import Episode, FeatureStore
from pipeline.train.batches import Ticks

APPROACH, CONTACT, HOLD = PHASES = ("approach", "contact", "hold")
PHASE_RULE = (
    "approach: out of contact by the force; contact: in it, moving; hold: in it, and the recorded "
    "motion of the tick is below half of its median in the contacts of that recording"
)
_HOLD = 0.5


def phases_of(store: FeatureStore, ticks: Ticks) -> NDArray[np.str_]:
    """(tick,) one of `PHASES`, or empty where the recording has no force."""
    phases = np.full(len(ticks), "", dtype="<U8")
    names = store.streams["sensor"]["names"]
    if columns := force_columns(names):
        episodes = store.episode_of(ticks)
        for index in np.unique(episodes):
            here, episode = episodes == index, store.episodes[index]
            phases[here] = _phases(store, episode, columns)[ticks[here] - episode.ticks.start]
    return phases


def _phases(store: FeatureStore, episode: Episode, columns: list[int]) -> NDArray[np.str_]:
    """(tick,) the phase of each tick of an episode."""
    first, stop = store.array("episode/sensor_start")[episode.index :][:2]
    time = store.array("sensor/time")[first:stop]
    phases = np.full(len(episode.ticks), APPROACH if len(time) else "", dtype="<U8")
    units = {store.streams["sensor"]["units"][column] for column in columns}
    force = store.array("sensor/values")[first:stop, columns]
    step_s = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    at = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    touching = np.zeros(len(at), np.bool_)
    for begin, end in contact_spans(time, force, units == {"N"}, step_s):
        touching |= (begin <= at) & (at <= end)
    if touching.any():
        motion = _motion(store, episode)
        still = motion < _HOLD * np.median(motion[touching])
        phases[touching] = np.where(still, HOLD, CONTACT)[touching]
    return phases


def _motion(store: FeatureStore, episode: Episode) -> NDArray[np.floating]:
    """(tick,) the length of each recorded motion: of the translation, else of all but grippers.

    The motion of an absolute action is its difference from the previous action.
    """
    action = store.streams["action"]
    groups = np.array(action_groups(action["names"], action["units"]))
    moving = groups == "translation" if "translation" in groups else groups != "gripper"
    values = store.array("tick/action")[episode.ticks.start : episode.ticks.stop, moving]
    if action["kind"] == "absolute":
        values = np.diff(values, axis=0, prepend=values[:1])
    return np.linalg.norm(values, axis=1)

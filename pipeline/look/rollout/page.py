"""The page of a policy's rollouts: how often it succeeds, and how it fails."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

from pipeline.evaluate.rollouts import RolloutEpisode, Rollouts, controller_name
from pipeline.look.page.blocks import Block, Document, Picture, Report, Section, Text
from pipeline.look.page.writing import sentence
from pipeline.look.rollout import pictures as plots
from pipeline.simulation.insertion import (
    AT_LAYER_MM,
    FORCE_LIMIT_N,
    HOLD_TICKS,
    MAX_TICKS,
    MISS_MM,
    OVERSHOOT_MM,
    TICK_S,
)

_SUCCESS = (
    f"An episode succeeds where the needle punctures within {MISS_MM:.1f} mm of the target, rests "
    f"within {AT_LAYER_MM:g} mm of the layer for {HOLD_TICKS} ticks, never goes more than "
    f"{OVERSHOOT_MM:g} mm beyond it, never meets more than {FORCE_LIMIT_N:g} N, and all of this "
    f"within {MAX_TICKS * TICK_S:g} s. Anything else ends it, with its reason. The levels are "
    "`depth`, which begins above the target, so that the sensor suffices, `full`, which begins "
    "anywhere, and `moved`, in which target and tissue are also pushed on the way."
)
_CONTROLLERS = (
    "The demonstrator is the rule that made the training data, and sees what the simulation hides. "
    "With a stream off, the same policy sees its training mean; with one frozen, for ever what it "
    "saw first. All of them meet the same episodes."
)


def rollout_report(rollouts: Rollouts) -> Report:
    """The page of these rollouts, those of `policy` in detail.

    Says nothing of the clock and nothing of where it is written: the same rollouts give the same
    page. Pictures ask the episodes for their frames when they are drawn.
    """
    rates, episodes = rollouts.rates(), rollouts.of("policy")
    shares = "; ".join(f"{controller_name(name)} {rate}" for name, rate in rates.items())
    return Report(
        title=f"Rollouts of {rollouts.checkpoint}",
        summary=(
            "The policy acts in the simulated needle insertion and sees what its actions lead to. "
            f"Episodes that succeed at level {rollouts.level}: {shares}."
        ),
        tiles=[("success of the policy", str(rates["policy"]))],
        sections=(
            Section("Success", _success(rollouts)),
            Section("Where the needle went", _places(rollouts)),
            Section("Episodes closely", (), tuple(_filmstrips(episodes))),
            Section("What was run", [Document("Settings of the rollout", rollouts.settings)]),
        ),
    )


def worst_and_median(episodes: Sequence[RolloutEpisode]) -> tuple[RolloutEpisode, RolloutEpisode]:
    """The worst episode, and that in the middle between it and the best.

    Those without success are worse than those with; among equals, the farther the tip was from
    the target and from the layer (mm, added), the worse.
    """
    ordered = sorted(
        episodes, key=lambda episode: (episode.success, -episode.lateral_mm - abs(episode.depth_mm))
    )
    return ordered[0], ordered[len(ordered) // 2]


def _success(rollouts: Rollouts) -> list[Block]:
    """How often, and why not."""
    return [Text(_SUCCESS), Text(_CONTROLLERS), rollouts.summary()]


def _places(rollouts: Rollouts) -> list[Block]:
    episodes = rollouts.of("policy")
    above = (
        "The way of the needle's tip as seen from the target. Points are where it punctured, or "
        "where it was in the end when it never did; in the circle, an insertion may succeed. Where "
        "a push moves the target, a line jumps. What goes farther leaves the picture."
    )
    over_time = (
        "A thin line is an episode. The tip is to be near the target before it goes below the "
        "surface, and to come to rest in the green band. Force is the largest in each tick; it "
        "falls when the needle punctures."
    )
    strong = {f"{kind}, seed {e.seed}": e for kind, e in _extremes(episodes).items()}
    return [
        Picture("paths", above, partial(plots.paths, rollouts)),
        Picture("courses", over_time, partial(plots.courses, episodes, strong)),
    ]


def _extremes(episodes: Sequence[RolloutEpisode]) -> Mapping[str, RolloutEpisode]:
    """The worst and the median; a single episode is only the worst."""
    worst, median = worst_and_median(episodes)
    return {"worst": worst} | ({} if median is worst else {"median": median})


def _filmstrips(episodes: Sequence[RolloutEpisode]) -> Iterator[Section]:
    caption = (
        "What the cameras saw at moments from the beginning to the end. While the needle presses "
        "and has not punctured, the layer gives way with it."
    )
    for kind, episode in _extremes(episodes).items():
        side = "short of" if episode.depth_mm > 0 else "beyond"
        words = (
            f"{sentence(episode.reason)} {episode.lateral_mm:.2f} mm sideways from the target at "
            f"the puncture, {abs(episode.depth_mm):.2f} mm {side} the layer in the end, at most "
            f"{episode.overshoot_mm:.2f} mm beyond it and {episode.max_force_n:.2f} N, "
            f"{episode.time_s:.1f} s."
        )
        title = f"{kind.capitalize()}: seed {episode.seed}, level {episode.level}"
        draw = partial(plots.filmstrip, episode, f"{title}, {episode.reason}")
        yield Section(title, [Text(words), Picture(f"filmstrip_{kind}", caption, draw)])

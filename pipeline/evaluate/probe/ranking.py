"""Which findings are better than which, as far as the folds can tell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.evaluate.probe.ridge import Score, standard_error
from pipeline.evaluate.probe.run import Finding, Study

Reading = Literal["beside", "alone"]
"""Together with state + sensor, or by itself."""


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The choice of layer, norm and pooling that the evidence supports."""

    reading: Reading
    """What it rests on: `beside` where a choice gains so, else `alone`."""
    best: Finding
    """With the highest score of those that gain."""
    chosen: Finding
    """Of `best` and those tied with it, the one with the fewest slots, then the lowest layer: it
    costs the least to extract, to keep and to read."""
    tied: tuple[Finding, ...]
    """The others that gain, not to be told from `best`."""


def ranked(findings: Sequence[Finding]) -> list[Finding]:
    """The best first; what could not be scored last."""
    scored = [one for one in findings if one.best is not None]
    rest = [one for one in findings if one.best is None]
    return [*sorted(scored, key=_rank, reverse=True), *rest]


def recommend(study: Study) -> Recommendation | None:
    """Among the groups that gain; None where none does.

    A group gains where it is better than what is known without features and than the mean action.
    One is better than another where the mean over folds of their difference is above its standard
    error (the one-standard-error rule of The Elements of Statistical Learning, section 7.10, on
    differences by fold, as all face the same recordings), and their median above 0, so that it does
    not rest on one strange fold. Two that gain are tied where the first is not better and the
    second keeps half of its gain: a wide spread of few folds would tie anything.
    """
    readings: tuple[Reading, ...] = ("beside", "alone")
    for reading in readings:
        scores = {one: score for one in study.groups if (score := _score(one, reading)) is not None}
        gains = {
            one: _gain(study, one, reading)
            for one, score in scores.items()
            if all(better(score, other) for other in _without(study, one, reading))
        }
        if gains:
            best, *others = sorted(gains, key=lambda one: gains[one], reverse=True)
            tied = tuple(
                one
                for one in others
                if not better(scores[best], scores[one]) and gains[one] >= gains[best] / 2
            )
            chosen = min(
                [best, *tied],
                key=lambda one: (len(one.slots), one.name.layer, -scores[one].mean),
            )
            return Recommendation(reading, best, chosen, tied)
    return None


def better(one: Score, other: Score) -> bool:
    """Fold by fold, as `recommend` says."""
    apart = one.by_fold - other.by_fold
    ahead = one.mean - other.mean > standard_error(apart)
    return bool(ahead and np.nanmedian(apart) > 0)


def gain_error(finding: Finding) -> float | None:
    """The standard error of `Finding.gain`, by fold."""
    if finding.beside is None or finding.without is None:
        return None
    return standard_error(finding.beside.by_fold - finding.without.by_fold)


def _without(study: Study, finding: Finding, reading: Reading) -> list[Score]:
    """What is known without the features."""
    known = finding.without if reading == "beside" else None
    return [study.mean_action] if known is None else [study.mean_action, known]


def _gain(study: Study, finding: Finding, reading: Reading) -> float:
    score = _score(finding, reading)
    assert score is not None, "only what was scored gains"
    return score.mean - max(one.mean for one in _without(study, finding, reading))


def _score(finding: Finding, reading: Reading) -> Score | None:
    return finding.beside if reading == "beside" else finding.alone


def _rank(finding: Finding) -> float:
    assert finding.best is not None, "only what was scored is ranked"
    return finding.best.mean

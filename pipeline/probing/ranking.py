"""Which findings are better than which, as far as the folds can tell."""

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.probing.ridge import Score, standard_error
from pipeline.probing.run import Finding, Study


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The choice of layer, norm and pooling that the evidence supports."""

    best: Finding
    """With the highest score."""
    chosen: Finding
    """Of `best` and those tied with it, the one with the fewest slots, then the lowest layer: it
    costs the least to extract, to keep and to read."""
    tied: tuple[Finding, ...]
    """The others within one standard error of `best`."""
    helps: bool
    """Whether `chosen` adds more than one standard error to what is known without features."""


def ranked(findings: Sequence[Finding]) -> list[Finding]:
    """The best first; what could not be scored last."""
    scored = [one for one in findings if one.best is not None]
    rest = [one for one in findings if one.best is None]
    return [*sorted(scored, key=_score, reverse=True), *rest]


def recommend(study: Study) -> Recommendation | None:
    """Among the groups; None where none could be scored.

    Two are tied where the mean over folds of their difference is within its standard error (the
    one-standard-error rule of The Elements of Statistical Learning, section 7.10, on differences by
    fold, as all face the same recordings).
    """
    scored = [one for one in ranked(study.groups) if one.best is not None]
    if not scored:
        return None
    best, *others = scored
    tied = tuple(one for one in others if not _better(best.best, one.best))
    chosen = min([best, *tied], key=lambda one: (len(one.slots), one.name.layer, -_score(one)))
    return Recommendation(
        best=best,
        chosen=chosen,
        tied=tied,
        helps=_better(chosen.best, chosen.without or study.mean_action),
    )


def gain_error(finding: Finding) -> float | None:
    """The standard error of `Finding.gain`, by fold."""
    if finding.beside is None or finding.without is None:
        return None
    return standard_error(finding.beside.by_fold - finding.without.by_fold)


def _better(one: Score | None, other: Score | None) -> bool:
    """By more than one standard error of the difference."""
    assert one is not None, "only what was scored is ranked"
    assert other is not None, "only what was scored is ranked"
    return one.mean - other.mean > standard_error(one.by_fold - other.by_fold)


def _score(finding: Finding) -> float:
    assert finding.best is not None, "only what was scored is ranked"
    return finding.best.mean

"""Look at recordings or at a store: one page, and its pictures as PNG files.

The page (report.html) needs no other file: open it from any folder, send it to anyone. It shows
what is there, when each stream was sampled, what the model and the policy receive, and what looks
wrong. Every recording is checked, some are shown in detail. The exit code is 0 if the page was
written, whatever was found, and 2 if there was nothing to look at.

  python -m stages.inspect                         the recordings of data.sources
  python -m stages.inspect PATH …                  recordings, folders or globs of them
  python -m stages.inspect cache_store/NAME.zarr   a store
  python -m stages.inspect PATH --set inspect.episodes=10
                                                   ten episodes in detail
  python -m stages.inspect PATH --rerun            episodes to scrub through, in Rerun

The page of PATH goes into a folder of its own in reports/inspect, named after PATH; without PATH it
goes into reports/inspect itself, and with --set inspect.output=FOLDER always into that one. Looking
again replaces the page, its pictures and findings.csv there, and touches no other file.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from stages.command import Shorthand, run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params
    from pipeline.look.page.blocks import Report
    from pipeline.look.subject import Subject

SECTIONS = ("inspect", "data")
SHORTHANDS = (
    *short("data", "--views"),
    *short("inspect", "--out"),
    Shorthand(
        "path",
        "inspect.path",
        "recordings, folders or globs of them, or a store",
        "PATH",
        "*",
        alone=True,
    ),
    Shorthand("--rerun", "inspect.rerun", "write Rerun files, to scrub through, and no page"),
)
SHOWN = 8
"""The most findings that the terminal shows."""


def main(params: "Params") -> None:
    """Write the page of what `inspect.path` names."""
    from pipeline.base.files import REPORT, claim
    from pipeline.look.page.blocks import FINDINGS
    from pipeline.look.page.writing import write_report
    from pipeline.look.subject import subject_of

    subject = subject_of(params)
    if params.inspect.rerun:
        from pipeline.look.rerun_files import write_episodes

        for folder in (params.inspect.output, subject.folder):
            claim(folder, REPORT)
        for path in write_episodes(subject, params):
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it with: rerun {path}")
        return
    report = _report(subject, params)
    for folder in (params.inspect.output, subject.folder):
        claim(folder, REPORT)
    page, *files = write_report(subject.folder, report)
    print("\n".join(summary(report)))
    pictures = sum(file.suffix == ".png" for file in files)
    print(f"{page}: the page, with {pictures} pictures and {FINDINGS} beside it")


def summary(report: "Report") -> Iterator[str]:
    """The beginning of the page, for a terminal."""
    from pipeline.look.page.blocks import FINDINGS, Issues, group_issues, place_of, places_of

    yield report.title
    yield " · ".join(f"{label} {value}" for label, value in report.tiles)
    # The first block of issues holds those of the whole page.
    issues = next(report.blocks(Issues))
    groups = group_issues(issues.issues)
    if not groups:
        yield issues.none
    for group in groups[:SHOWN]:
        first = group[0]
        place = f", the first {place_of(first)}" if len(group) > 1 else ""
        yield f"{first.severity}: {first.kind}: {places_of(group)}{place}"
        yield f"    {' '.join(first.message.split())}"
    if len(groups) > SHOWN:
        yield f"… and {len(groups) - SHOWN} more on the page and in {FINDINGS}"


def _report(subject: "Subject", params: "Params") -> "Report":
    from pipeline.look.recording.page import recordings_report
    from pipeline.look.store import inspect_store, store_report

    if subject.store is not None:
        return store_report(inspect_store(subject.store, params.inspect))
    return recordings_report(subject.recordings(params.data.views), params, subject.name)


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

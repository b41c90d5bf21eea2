"""Look at recordings or at a store: one page, and its pictures as PNG files.

The page (report.html) needs nothing beside itself: open it from any folder, send it to anyone. It
shows what is there, when each stream was sampled, what the model and the policy get of it, and what
looks wrong. Every recording is checked, some are shown in detail. The exit code is 0 once the page
is written, whatever it finds, and 2 where nothing could be looked at.

  python -m stages.inspect                         the recordings of data.sources
  python -m stages.inspect PATH …                  recordings, folders or globs of them
  python -m stages.inspect cache_store/NAME.zarr   a store
  python -m stages.inspect PATH --set inspect.episodes=10
                                                   ten episodes in detail

The page of PATH goes into a folder of its own in reports/inspect, named after PATH; without PATH it
goes into reports/inspect itself, and with --set inspect.output=FOLDER always into that one. Looking
again replaces the page and its pictures there, and touches no other file.
"""

from collections.abc import Iterator, Sequence

from pipeline.config import Params
from pipeline.inspection.store import inspect_store
from pipeline.report import Notice, Notices, Report, Section, write_report
from pipeline.report.recording import recordings_report
from pipeline.report.store import store_report
from pipeline.report.subject import Subject, subject_of
from stages.command import Shorthand, run

PATH = Shorthand(
    "path", "inspect.path", "recordings, folders or globs of them, or a store", "PATH", "*"
)
SAID = 8
"""Findings that the terminal shows."""


def main(params: Params) -> None:
    """Write the page of what `inspect.path` names."""
    subject = subject_of(params)
    report = _report(subject, params)
    page, *pictures = write_report(subject.folder, report)
    print("\n".join(summary(report)))
    print(f"{page}: the page, with {len(pictures)} pictures beside it")


def summary(report: Report) -> Iterator[str]:
    """What the page says first, for a terminal."""
    yield report.title
    yield " · ".join(f"{label} {value}" for label, value in report.tiles)
    found = _first_notices(report.sections)
    if found is None:
        return
    if not found.notices:
        yield found.none
    worst_first = sorted(found.notices, key=lambda one: one.severity != "error")
    for one in worst_first[:SAID]:
        yield f"{one.severity}: {one.kind}: {one.where}"
        yield f"    {_line(one)}"
    if len(found.notices) > SAID:
        yield f"… and {len(found.notices) - SAID} more on the page"


def _report(subject: Subject, params: Params) -> Report:
    if subject.store is not None:
        return store_report(inspect_store(subject.store, params.inspect))
    return recordings_report(subject.recordings(params.data.views), params, subject.name)


def _first_notices(sections: Sequence[Section]) -> Notices | None:
    """The notices of all: those of single parts come later."""
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Notices):
                return block
    return None


def _line(notice: Notice) -> str:
    return " ".join(notice.message.split())


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=[PATH], sections=("inspect", "data")))

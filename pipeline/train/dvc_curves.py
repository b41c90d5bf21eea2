"""The curves of a run as DVC reads them."""

from collections.abc import Mapping
from pathlib import Path

from dvclive import Live

from pipeline.train.live_page import Turns


class DVCCurves:
    """Curves in `<folder>/plots/metrics/*.tsv`, their newest values in `<folder>/metrics.json`.

    With `report`, dvclive draws them there too, on a page that fetches its drawing library from the
    network and never stops looking again.
    """

    def __init__(self, folder: Path, report: Path | None = None) -> None:
        self.note = "" if report is None else f"live: open {report} in a browser with a network"
        self._live, self._turns = _Live(folder, report), Turns()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a line to each file; draw the report if it is due."""
        self._live.step = step
        for name, value in metrics.items():
            self._live.log_metric(name, value)
        self._live.make_summary()
        self._turns.take(self._live.make_report)

    def close(self, finished: bool) -> None:
        """Write the summary and the report a last time."""
        self._live.end()


class _Live(Live):
    """dvclive's files without its repository, and its report where it is told.

    On start dvclive looks for git and DVC around the working directory: it fails in a repository
    without a commit and runs `dvc init` in one that does not use DVC. All of that serves
    experiments (`save_dvc_exp`), which DVC itself makes here, from the outputs in dvc.yaml.
    """

    def __init__(self, folder: Path, report: Path | None) -> None:
        self._report_path = report
        super().__init__(
            str(folder),
            report=None if report is None else "html",
            dvcyaml=None,
            save_dvc_exp=False,
        )

    @property
    def report_file(self) -> str | None:
        """Outside of the folder: its curves stand in it in the order of the file system."""
        return None if self._report_path is None else str(self._report_path)

    def _init_dvc(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._dvc_file = "dvc.yaml"

    def _init_resume(self) -> None:
        # DVCLIVE_RESUME=true asks for it, but the rows of before are written again.
        self._init_cleanup()

"""What every command shares: its options, its exit codes, a clean stop."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

from pipeline.config import Params, load_params
from pipeline.errors import PipelineError


def run(
    summary: str, work: Callable[[Params], None], arguments: Sequence[str] | None = None
) -> int:
    """Parse the options, do the work, return the exit code.

    0 done; 2 something the user can mend, said in one message without a traceback; 1 stopped by
    Ctrl-C or SIGTERM, or a bug, which keeps its traceback.
    """
    parser = argparse.ArgumentParser(
        description=summary, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--params", type=Path, default=Path("params.yaml"), metavar="FILE")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="section.key=value",
        help="lay a value (YAML) over the file; may be given several times",
    )
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        work(load_params(options.params, options.overrides))
    except PipelineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        said = f"{place}{error.strerror or error}. Look at that path, then run the same again."
        print(f"error: {said}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command continues from here", file=sys.stderr)
        return 1
    return 0


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Make SIGTERM stop as Ctrl-C does: through every `finally`."""
    raise KeyboardInterrupt

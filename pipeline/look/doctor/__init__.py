"""What this machine has, lacks and could have for the pipeline, and what to install or set.

A group of checks is imported when its turn comes, so that a package that is broken or missing is a
finding and not the end.
"""

from collections.abc import Callable, Generator
from importlib import import_module
from queue import Empty, SimpleQueue
from threading import Thread

from pipeline.base.config import Params
from pipeline.base.errors import PipelineError
from pipeline.look.doctor.findings import Finding, described, missing, note

__all__ = ["GROUPS", "Finding", "described", "examine"]

PATIENCE_S = 10.0
"""How long a group of checks may take; what hangs, such as a network disk, is named and left."""

GROUPS = (
    ("Python and packages", "packages", "check_packages"),
    ("GPU", "gpu", "check_gpu"),
    ("Attention", "attention", "check_attention"),
    ("Video decoders", "decoders", "check_decoders"),
    ("Vision-language model", "checkpoint", "check_checkpoint"),
    ("Recordings", "data", "check_data"),
    ("The store", "space", "check_space"),
    ("DVC's cache", "links", "check_links"),
    ("Machine", "limits", "check_limits_here"),
)
"""Title, module of this package and function from `Params` to findings."""


def examine(params: Params) -> Generator[tuple[str, list[Finding]]]:
    """Each group's title and findings, one after the other.

    A check that fails by a bug of its own costs its group alone: raises `ExceptionGroup` of all
    those, at the end.
    """
    bugs: list[Exception] = []
    for title, module, function in GROUPS:
        try:
            check = getattr(import_module(f"pipeline.look.doctor.{module}"), function)
        except (ImportError, OSError) as error:
            said = f"cannot be looked at: {error}"
            yield (
                title,
                [missing(module, said, "install what is missing above, and run this again")],
            )
            continue
        except Exception as error:
            bugs.append(error)
            yield title, [_failed(module, function, error)]
            continue
        answer: SimpleQueue[list[Finding] | Exception] = SimpleQueue()
        Thread(target=_answer, args=(answer, module, check, params), daemon=True).start()
        try:
            found = answer.get(timeout=PATIENCE_S)
        except Empty:
            said = f"not known: no answer within {PATIENCE_S:g} s"
            found = [note(module, said, "look at the disk or device it waits for")]
        if isinstance(found, Exception):
            bugs.append(found)
            found = [_failed(module, function, found)]
        yield title, found
    if bugs:
        raise ExceptionGroup("checks that failed; the others stand above", bugs)


def _failed(module: str, function: str, error: Exception) -> Finding:
    said = f"{function} failed with {type(error).__name__}: {error}"
    return note(module, said, "its traceback stands at the end; report it")


def _answer(
    answer: SimpleQueue[list[Finding] | Exception],
    module: str,
    check: Callable[[Params], list[Finding]],
    params: Params,
) -> None:
    """Put what a check finds; what it cannot look at is a finding too, a bug is an error."""
    try:
        answer.put(check(params))
    except PipelineError as error:
        answer.put([missing(module, str(error), "mend that, and run this again")])
    except OSError as error:
        answer.put([note(module, f"not known: {error}", "look at that path")])
    except Exception as error:
        answer.put(error)

"""The border for files from outside: each is read once, within bounds, and refused in one form.

A document becomes a pydantic model. Any fault becomes one error that names the file, the place, the
expected and the actual value, and the remedy. Each room has a `Border` with its own kind of error;
code behind it uses the models, never a raw dictionary.
"""

import gc
import re
import stat
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from reprlib import Repr
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from pipeline.base.errors import PipelineError

T = TypeVar("T")

MOST_BYTES = 32 * 2**20
"""Most bytes of one document; the largest usual one is a tokenizer's, with 11 MB."""
Text = Annotated[str, Field(max_length=10_000, pattern=r"^[^\x00]*$")]
"""A name, path or instruction: bounded, and without NUL, which no file system allows."""
_WEIGHTS = {b",": 1, b":": 8, b"[": 8, b"{": 8}
MOST_WEIGHT = 4_000_000
"""Limit on a document's values (1 each), keys and lists (8 each). pydantic keeps a refused value
once per problem, so a model of a dozen fields can take 1.5 GB. A tokenizer weighs 3e6."""
_WORDINGS = {
    "Extra inputs are not permitted": "unknown key",
    "Field required": "missing",
    "Input is not a valid path for <class 'pathlib.Path'>": "expected a path",
    "Input should be a valid tuple": "expected a list such as [a, b]",
    "Input should be ": "expected ",
    "Input should": "expected to",
    "Tuple should": "expected a list to",
    "String should": "expected a text to",
    "Invalid JSON": "cannot be read as JSON",
}
"""pydantic's wording -> ours."""
_MOST_PROBLEMS = 5
"""Problems that one message lists."""


class Document(BaseModel):
    """Base of documents from outside: types are strict, unknown keys are ignored."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


@dataclass(frozen=True)
class Border:
    """How one kind of input is refused."""

    error: type[PipelineError]
    mend: str
    """What to do about it, as one or more sentences with a full stop."""

    def refusal(self, where: Path | str, why: object) -> PipelineError:
        """The error for the file or place `where`, with the reason."""
        return self.error(f"{named(str(where))}: {str(why).rstrip('.: ')}. {self.mend}")

    def check_file(self, path: Path, most: int | None = None) -> int:
        """The size of a regular file; refuses a folder, pipe or device, and more than `most` bytes.

        To open a pipe would wait for its writer, and a device has no end.
        """
        with self.foreign(path, "cannot be read"):
            try:
                status = path.stat()
            except FileNotFoundError:
                raise self.refusal(path, "no such file") from None
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, socket or device"
            raise self.refusal(path, f"expected a file, found {kind}")
        if most is not None and status.st_size > most:
            why = f"expected at most {most:,} bytes, found {status.st_size:,}"
            raise self.refusal(path, why)
        return status.st_size

    def read_bytes(self, path: Path, most: int = MOST_BYTES) -> bytes:
        """The content of a regular file of at most `most` bytes."""
        self.check_file(path, most)
        with self.foreign(path, "cannot be read"), path.open("rb") as file:
            return file.read(most)

    def read_json(self, path: Path, model: type[T], most: int = MOST_BYTES) -> T:
        """The JSON document of a file, as the model; refuses more than 200 levels."""
        return self.parse_json(self.read_bytes(path, most), model, path)

    def parse_json(
        self, text: bytes | str, model: type[T], where: Path | str, most: int = MOST_WEIGHT
    ) -> T:
        """The JSON document of a text, as the model; refuses more than `most` weight."""
        raw = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
        weight = sum(mark_weight * raw.count(mark) for mark, mark_weight in _WEIGHTS.items())
        if weight > most:
            why = f"expected a document of weight {most:,} (a value 1, a key or a list 8)"
            raise self.refusal(where, f"{why}, found {weight:,}")
        try:
            with uncollected():
                return _adapter(model).validate_json(raw)
        except ValidationError as error:
            raise self.refusal(where, _first_problems(error)) from None

    def read_json_lines(self, path: Path, model: type[T], most: int = 2**20) -> Iterator[T]:
        """The documents of a file with one per line, each of at most `most` bytes; skips empty
        lines."""
        self.check_file(path)
        with self.foreign(path, "cannot be read"), path.open("rb") as file:
            for number, line in enumerate(iter(lambda: file.readline(most + 1), b""), start=1):
                where = f"{path}, line {number}"
                if len(line) > most:
                    raise self.refusal(where, f"expected at most {most:,} bytes, found more")
                if line.strip():
                    yield self.parse_json(line, model, where)

    def parse(self, value: object, model: type[T], where: Path | str) -> T:
        """A value from another parser, as the model."""
        try:
            return _adapter(model).validate_python(value)
        except ValidationError as error:
            raise self.refusal(where, _first_problems(error)) from None

    @contextmanager
    def foreign(self, where: Path | str, what: str) -> Generator[None]:
        """Turn an error of another library inside into a refusal that begins with `what`."""
        try:
            yield
        except BaseException as error:
            panic = type(error).__name__ == "PanicException"  # Rust's, not an `Exception`
            if isinstance(error, PipelineError) or not (panic or isinstance(error, Exception)):
                raise
            text = str(error).removeprefix("Error(s) in ")  # torch's prefix for several
            reason = str(getattr(error, "strerror", None) or f"{type(error).__name__}: {text}")
            why = re.sub(r"<class '(\w+)'>", r"\1", f"{what}: {' '.join(reason.split()):.300}")
            raise self.refusal(where, _printable(why)) from error


@contextmanager
def uncollected() -> Generator[None]:
    """Pause garbage collection while a document is parsed, because it takes most of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _first_problems(error: ValidationError) -> str:
    """The first few problems of a model, as one line."""
    lines = [f"{place}: {what}" if place else what for place, what in problems(error)]
    more = f"; and {len(lines) - _MOST_PROBLEMS} more" if len(lines) > _MOST_PROBLEMS else ""
    return "; ".join(lines[:_MOST_PROBLEMS]) + more


def problems(error: ValidationError) -> Iterator[tuple[str, str]]:
    """The place of each problem, such as `a.b.0`, and what was expected and found there."""
    for problem in error.errors(include_url=False, include_context=False):
        text = problem["msg"].removeprefix("Value error, ")
        for wording, ours in _WORDINGS.items():
            text = text.replace(wording, ours)
        if problem["type"] in ("model_type", "model_attributes_type", "dataclass_type"):
            text = "expected an object"
        if problem["type"] == "json_invalid":
            pass
        elif not isinstance(problem["input"], dict):
            text += f", found {shown(problem['input'])}"
        elif problem["type"] not in ("missing", "extra_forbidden", "value_error"):
            text += ", found keys with values"  # in full they would hide it
        yield named(".".join(map(str, problem["loc"]))), text


class _Short(Repr):
    def repr_int(self, x: int, level: int) -> str:
        bits = x.bit_length()  # Python writes at most 4,300 digits
        return super().repr_int(x, level) if bits < 9999 else f"an integer of {bits} bits"


_SHORT = _Short()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 120, 120


def shown(value: object) -> str:
    """A value for a message: short, with characters that every terminal can print."""
    return _printable(_SHORT.repr(value))


def _printable(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


def named(text: str) -> str:
    """A name, path or place for a message: unchanged if it is printable and short enough."""
    return text if len(text) <= 1000 and text.isprintable() else shown(text)


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    return TypeAdapter(model)

"""The keys of params.yaml, for people."""

import inspect
import json
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic.fields import FieldInfo

from pipeline.base.config.section import Section
from pipeline.base.config.sections import Params


def described_keys(sections: Sequence[str]) -> list[str]:
    """Every key of these sections: a line with its default, and what it means below."""
    lines: list[str] = []
    for name in sections:
        section = Params.model_fields[name].annotation
        assert isinstance(section, type) and issubclass(section, Section), name
        lines += [f"{name}: {inspect.getdoc(section)}", *_lines(section, name), ""]
    return lines[:-1]


def _lines(section: type[Section], place: str) -> Iterator[str]:
    for name, field in section.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, Section):
            yield from _lines(inner, f"{place}.{name}")
            continue
        yield f"  {place}.{name} = {_default(field)}"
        for line in (field.description or "").splitlines():
            yield f"      {line.strip()}"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "(has to be given)"
    value: Any = field.get_default(call_default_factory=True, validated_data={})
    return json.dumps(value, default=str)

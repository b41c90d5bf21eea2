"""params.yaml as `Params`: all sections, the description of their keys, and reading the file."""

import inspect
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from pipeline.base.config.extraction import (
    ArchiveParams,
    DataParams,
    DemoParams,
    ExtractParams,
    InspectParams,
    ProbeParams,
    StoresParams,
    VerifyParams,
    VLMParams,
)
from pipeline.base.config.policies import (
    CompareParams,
    DriveParams,
    EvaluateParams,
    ExportParams,
    PushParams,
    RolloutParams,
    ServeParams,
)
from pipeline.base.config.section import Section
from pipeline.base.config.training import FinetuneParams, TrainHeadParams
from pipeline.base.documents import Border, named, problems, shown
from pipeline.base.errors import ConfigError


class Params(Section):
    """All of params.yaml."""

    demo: DemoParams = DemoParams()
    data: DataParams
    vlm: VLMParams
    extract: ExtractParams = ExtractParams()
    train_head: TrainHeadParams = TrainHeadParams()
    evaluate: EvaluateParams = EvaluateParams()
    rollout: RolloutParams = RolloutParams()
    serve: ServeParams = ServeParams()
    drive: DriveParams = DriveParams()
    export: ExportParams = ExportParams()
    finetune: FinetuneParams = FinetuneParams()
    compare: CompareParams = CompareParams()
    verify: VerifyParams = VerifyParams()
    archive: ArchiveParams = ArchiveParams()
    probe: ProbeParams = ProbeParams()
    stores: StoresParams = StoresParams()
    push: PushParams = PushParams()
    inspect: InspectParams = InspectParams()


def described_keys(sections: Sequence[str]) -> list[str]:
    """Every key of these sections: a line with its default, then its meaning."""
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


_Section = TypeVar("_Section", bound=Section)

_MOST_PROBLEMS = 50
"""Problems that one message lists."""
_FILE = Border(ConfigError, "Run from the project's root, name it (--params FILE), or correct it.")
_SET = Border(
    ConfigError,
    "The value is YAML: put a text that it reads as something else in quotes of its own, as in "
    "--set 'section.key=\"a text\"'.",
)
_DEMO = {
    "data": {"sources": [{"name": "demo", "path": "."}]},
    "vlm": {"checkpoint": "models/demo_vlm"},
}
"""The keys that have no default, for the demo."""
_REPLACED = {
    "train_head.val_fraction": "is no longer a key, because episodes are split three ways. Write "
    "train_head.split={val: 0.15, test: 0.15}: val chooses the checkpoint and stops early, test is "
    "what stages.evaluate reports on",
}
"""Keys of earlier versions, and their replacements."""


def load_params(path: Path | None, overrides: Sequence[str] = ()) -> Params:
    """The params of a YAML file after `section.key=value` overrides; of None, the defaults.

    Without a file the keys that have no default are the demo's.
    A value is YAML, so `[1, 2]`, `null` and JSON work. Raises one `ConfigError` with every problem.
    """
    document = deepcopy(_DEMO) if path is None else _read(path)
    for override in overrides:
        _lay_over(document, override)
    where = "the defaults" if path is None else str(path)
    where = f"{where} with what --set lays over it" if overrides else where
    return _as_section(document, Params, where)


def load_section(path: Path, section: type[_Section]) -> _Section:
    """A section that is in its own YAML file.

    Raises one `ConfigError` with every problem, by file and key.
    """
    return _as_section(_read(path), section, str(path))


def setting(key: str, value: Path | str | Sequence[str] | Mapping[str, Any]) -> str:
    """`--set key=value` for advice; quoted for a shell, so that it gives this value."""
    alone = isinstance(value, Path | str)
    plain = [str(value)] if alone else value
    text = yaml.safe_dump(
        plain, default_flow_style=True, allow_unicode=True, width=float("inf")
    ).strip()
    text = text[1:-1] if alone else text
    return f"--set {shlex.quote(f'{key}={text}')}"


def _read(path: Path) -> dict[str, Any]:
    """The keys of a YAML file."""
    document = _parse(_FILE.read_bytes(path), _FILE, path)
    if not isinstance(document, dict):
        raise _FILE.refusal(path, f"expected sections such as `data:`, found {shown(document)}")
    return document


def _lay_over(document: dict[str, Any], override: str) -> None:
    dotted, equals, text = override.partition("=")
    where, keys = f"--set {named(override)}", dotted.split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise _SET.refusal(where, "expected section.key=value")
    value, node = _parse(text, _SET, where), document
    for depth, key in enumerate(keys[:-1], start=1):
        child = node.get(key)
        if child is None:
            child = {}
        if not isinstance(child, dict):
            above = named(".".join(keys[:depth]))
            why = f"{above} is a {type(child).__name__}, not a section; set it whole"
            raise _SET.refusal(where, why)
        # A copy, because a YAML alias may share it with another section.
        node[key] = dict(child)
        node = node[key]
    node[keys[-1]] = value


class _Loader(yaml.SafeLoader):
    """The safe loader; a date stays text, and a repeated key in a section is refused."""

    yaml_implicit_resolvers: ClassVar = {
        first: [resolver for resolver in resolvers if resolver[0] != "tag:yaml.org,2002:timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Refuse repeated keys; PyYAML itself would keep the last one."""
        node: Any = super().compose_mapping_node(anchor)
        keys = set[str]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in keys:
                why = f"the key {shown(key.value)} stands twice in one section"
                raise yaml.MarkedYAMLError(problem=why, problem_mark=key.start_mark)
            keys.add(str(key.value))
        return node


def _parse(text: bytes | str, border: Border, where: Path | str) -> Any:
    """The one document of a text."""
    with border.foreign(where, "cannot be read as YAML"):
        try:
            return yaml.load(text, _Loader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            at = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
            why = f"cannot be read as YAML: {at}{error.problem}"
            raise border.refusal(where, why) from None


def _as_section(document: dict[str, Any], section: type[_Section], where: str) -> _Section:
    try:
        return section.model_validate(document)
    except ValidationError as error:
        lines = [f"{named(where)}: {error.error_count()} problem(s)"]
        for place, why in islice(problems(error), _MOST_PROBLEMS):
            if why.startswith("unknown key"):
                why = _REPLACED.get(place, "unknown key; --keys lists those that there are")
            lines.append(f"  {place or section.__name__.lower()}: {why}")
        lines.append(f"Correct {'it' if len(lines) == 2 else 'them'}, and run the same again.")
        raise ConfigError("\n".join(lines)) from None

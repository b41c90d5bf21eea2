"""All sections together, and the description of their keys."""

import inspect
import json
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import model_validator
from pydantic.fields import FieldInfo

from pipeline.base.config.section import Section
from pipeline.base.config.stage_one import (
    DataParams,
    DemoParams,
    ExtractParams,
    InspectParams,
    VLMParams,
)
from pipeline.base.config.stage_two import (
    CompareParams,
    DriveParams,
    EvaluateParams,
    ExportParams,
    FinetuneParams,
    RolloutParams,
    ServeParams,
    TrainHeadParams,
)
from pipeline.base.config.stores import (
    ArchiveParams,
    ProbeParams,
    PushParams,
    StoresParams,
    VerifyParams,
)


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

    @model_validator(mode="after")
    def _mixture_names_sources(self) -> "Params":
        names = [source.name for source in self.data.sources]
        unknown = sorted(set(self.train_head.mixture) - set(names))
        if unknown and self.train_head.store is None:
            mixture, there = ", ".join(unknown), ", ".join(names)
            raise ValueError(f"train_head.mixture names {mixture}, but data.sources has {there}")
        return self


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

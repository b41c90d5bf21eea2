"""All sections together."""

from pydantic import model_validator

from pipeline.base.config.finetune import FinetuneParams
from pipeline.base.config.inspect import InspectParams
from pipeline.base.config.section import Section
from pipeline.base.config.stage_one import DataParams, DemoParams, ExtractParams, VLMParams
from pipeline.base.config.stage_two import CompareParams, EvaluateParams, TrainHeadParams
from pipeline.base.config.stores import ArchiveParams, ProbeParams, StoresParams, VerifyParams


class Params(Section):
    """All of params.yaml."""

    demo: DemoParams = DemoParams()
    data: DataParams
    vlm: VLMParams
    extract: ExtractParams = ExtractParams()
    train_head: TrainHeadParams = TrainHeadParams()
    evaluate: EvaluateParams = EvaluateParams()
    finetune: FinetuneParams = FinetuneParams()
    compare: CompareParams = CompareParams()
    verify: VerifyParams = VerifyParams()
    archive: ArchiveParams = ArchiveParams()
    probe: ProbeParams = ProbeParams()
    stores: StoresParams = StoresParams()
    inspect: InspectParams = InspectParams()

    @model_validator(mode="after")
    def _mixture_names_sources(self) -> "Params":
        names = [source.name for source in self.data.sources]
        unknown = sorted(set(self.train_head.mixture) - set(names))
        if unknown and self.train_head.store is None:
            raise ValueError(
                f"train_head.mixture names {', '.join(unknown)}, "
                f"but data.sources has {', '.join(names)}"
            )
        return self

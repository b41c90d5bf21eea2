"""The forward pass alone: rows/s and share of the peak by batch size, and which kernels take long.

    python -m benchmarks.forward [--quick] [--rows N]

Where there is CUDA, Qwen2.5-VL-3B's real shape with random bfloat16 weights on 3 views of
360 x 640; else the demo's checkpoint. Rows are prepared beforehand. The vision tower's MLPs are
3,420 wide, as loaded, or padded with zeros, as `FrozenVLM` has them on a GPU.
"""

import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from unittest.mock import patch

import torch
from transformers import Qwen2_5_VLConfig

from benchmarks.cases import Case, demo_case, frozen_model, real_case
from benchmarks.flops import RowCost, peak_flops
from benchmarks.profiling import kernel_table
from benchmarks.real_shape import write_shell
from benchmarks.timing import Work, arguments, race, report
from benchmarks.workload import Workload, params_of, write_recordings
from pipeline.base.digests import ContentDigests
from pipeline.extract.rows import ReadyRow, RowPreparation
from pipeline.vlm import vision
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from pipeline.vlm.preparation import PreparedRow
from pipeline.vlm.qwen import FrozenVLM


def main() -> None:
    """Race batch sizes, padded and not, and print the report."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--rows", type=int, default=64, help="rows that each contender encodes")
    wanted = parser.parse_args()
    cuda, quick = torch.cuda.is_available(), wanted.quick
    case = real_case(3, wanted.rows) if cuda else demo_case(4 if quick else wanted.rows)
    sizes = (4,) if quick else (8, 16, 32, 64)
    with tempfile.TemporaryDirectory() as place:
        rows, workload = _prepared(case, Path(place))
        models = {"padded": frozen_model(case, workload, False)}
        if cuda:
            with patch("pipeline.vlm.qwen.pad_mlps"):
                models["as loaded"] = frozen_model(case, workload, False)
        works: dict[str, Work] = {
            f"{name}, {size}": lambda m=model, n=size: _encode(m, rows, n)
            for name, model in models.items()
            for size in sizes
        }
        raced = race(works, rounds=1 if quick else wanted.rounds or 3, warmup=0 if quick else 1)
        config = Qwen2_5_VLConfig.from_pretrained(Path(place) / "vlm", trust_remote_code=False)
        size = workload.survey.spec.image_size
        cost = RowCost.of(config, size, case.views, workload.text_tokens())
        results = raced.results({"rows": len(rows)})
        peak = peak_flops(torch.cuda.get_device_name()) if cuda else None
        for one in results.values():
            if peak is not None:
                one["mfu"] = one["rows_per_s"] * cost.total() / peak
        model, most = models["padded"], sizes[-1]
        kernels = kernel_table(lambda: _encode(model, rows, most)) if cuda else {}
    report(
        "forward",
        settings={"rows": len(rows), "tokens_a_row": cost.tokens, "padded_to": vision.MLP_MULTIPLE},
        results=results | {"kernels_s": kernels},
        ratios=raced.ratios(f"padded, {sizes[0]}"),
        targets=[],
        quick=quick,
        device="cuda" if cuda else "cpu",
    )


def _prepared(case: Case, folder: Path) -> tuple[Sequence[PreparedRow], Workload]:
    """The rows, ready for the model."""
    write_recordings(folder, case.rows, case.views, case.frame_size)
    (write_shell if case.real_shape else write_demo_checkpoint)(folder / "vlm")
    with closing(ContentDigests(folder / "digests.sqlite")) as digests:
        workload = Workload.of(params_of(folder, case.device, case.vlm), case.rows, digests)
        preparation = RowPreparation(workload.survey, [])
        ready = (row for rows in workload.ranges() for row in preparation.prepare(rows, None))
        return [row.variants[0] for row in ready if isinstance(row, ReadyRow)], workload


def _encode(model: FrozenVLM, rows: Sequence[PreparedRow], size: int) -> None:
    """All rows in batches, one batch ahead of the results."""
    before = None
    for start in range(0, len(rows), size):
        pending = model.submit(rows[start : start + size])
        if before is not None:
            before.result()
        before = pending
    if before is not None:
        before.result()


if __name__ == "__main__":
    main()

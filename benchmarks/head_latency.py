"""What one act of the head takes, batch 1, for every expert: eager, compiled and exported.

The head is that of `params.yaml` with random weights, with the demo's features (49 slots of 128)
and with as many as Qwen2.5-VL-3B would give (49 slots of 2,048), 1,026 sensor channels and 12 of
the state. Each round runs every way once, on the same observation, and ratios are taken within a
round. A way is left out, with the reason, where a package is missing or does not work here.
"""

import statistics
import tempfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.timing import Race, Work, arguments, race, report
from pipeline.base.config import ExportParams, ModelType, TrainHeadParams, load_params
from pipeline.base.errors import PipelineError
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.policy.shape import channel_kinds
from pipeline.robot.export import Head, Inputs, export_head, onnx_session, random_inputs

EXPERTS: tuple[ModelType, ...] = ("regression", "diffusion", "flow_matching")
DIMS = {"demo": 128, "3B": 2048}
GROUPS = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
STATE = [*(f"joint_{i}" for i in range(6)), *(f"pose_{axis}" for axis in "xyzabr")]
EAGER = "eager"
SMALL: dict[str, Any] = {
    "sensor_encoder": {"kind": "joint", "channels": [8], "layers": 1, "heads": 2, "output_dim": 8},
    "expert": {"dim": 16, "layers": 1, "heads": 2},
    "diffusion": {"sampling_steps": 2},
    "flow_matching": {"sampling_steps": 2},
}


def main() -> None:
    """Build, export, race, print."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--no-compile", action="store_true", help="leave torch.compile out")
    parser.add_argument("--sizes", nargs="+", choices=DIMS, default=list(DIMS))
    options = parser.parse_args()
    quick = options.quick
    rounds = options.rounds or (3 if quick else 300)
    experts: tuple[ModelType, ...] = EXPERTS[:1] if quick else EXPERTS
    sizes: list[str] = ["demo"] if quick else options.sizes
    cases = list(product(sizes, experts))
    results: dict[str, Any] = {}
    ratios: dict[str, Any] = {}
    threads_before = torch.get_num_threads()
    with tempfile.TemporaryDirectory(prefix="head-latency-") as folder:
        for size, expert in cases:
            checkpoint = checkpoint_of(size, expert, quick)
            place = Path(folder) / f"{size}-{expert}"
            ways, notes = build_ways(checkpoint, place, not (quick or options.no_compile))
            for threads in (1,) if quick else (2, 1):
                torch.set_num_threads(threads)
                found = race(ways(threads), rounds, warmup=2 if quick else 20)
                name = f"{expert}, {size}, {threads} thread{'s' * (threads > 1)}"
                results[name] = percentiles(found) | notes
                ratios[name] = found.ratios(EAGER)
            if torch.cuda.is_available():
                found = race(gpu_ways(checkpoint), rounds, warmup=20)
                results[f"{expert}, {size}, GPU"] = percentiles(found)
                ratios[f"{expert}, {size}, GPU"] = found.ratios(EAGER)
    torch.set_num_threads(threads_before)
    report(
        "head_latency",
        settings={"batch": 1, "rounds": rounds, "slots": 49, "dims": DIMS, "sensor_channels": 1026},
        results=results,
        ratios=ratios,
        targets=[],
        quick=quick,
        device="cuda" if torch.cuda.is_available() else "cpu",
    )


def checkpoint_of(size: str, expert: ModelType, quick: bool) -> PolicyCheckpoint:
    """The default head for these features, with random weights."""
    given = load_params(Path("params.yaml")).train_head.model_dump() | {"model_type": expert}
    params = TrainHeadParams.model_validate(given | (SMALL if quick else {}))
    kinds = channel_kinds(STATE, ["deg"] * 6 + ["mm"] * 3 + ["deg"] * 3)
    shape = PolicyShape(49, DIMS[size], 1026, 12, 7, GROUPS, views=3, state_kinds=kinds)
    fitted = {
        name: ChannelStatistics(np.zeros(axes), np.ones(axes), 1)
        for name, axes in shape.channels.items()
    }
    normalization = Normalization(**fitted)
    torch.manual_seed(0)
    weights = Policy(params, shape, normalization).state_dict()
    weights["expert.denoiser.head.weight" if expert != "regression" else "expert.head.weight"] *= 10
    names = {"action": 7, "sensor": 1026, "state": 12}
    streams: dict[str, Any] = {
        name: {"names": [f"{name}_{i}" for i in range(width)], "units": [""] * width, "kind": ""}
        for name, width in names.items()
    }
    source = {
        "feature_spec": {"digest": "random"},
        "streams": streams | {"views": ["View1", "View2", "View3"]},
        "action_hz": 10.0,
        "vlm_reuse_count": 3,
    }
    return PolicyCheckpoint(params, shape, normalization, source, {}, 0, weights)


def build_ways(
    checkpoint: PolicyCheckpoint, folder: Path, compiled: bool
) -> tuple[Callable[[int], dict[str, Work]], dict[str, Any]]:
    """The contenders on so many threads, and what is to be said of them."""
    policy = checkpoint.policy()
    head, given = Head(policy).eval(), one_tick(checkpoint, policy)
    fixed: dict[str, Work] = {EAGER: no_grad(lambda: head(**given))}
    notes: dict[str, Any] = {}
    if compiled:
        fast: Any = torch.compile(head)
        try:
            no_grad(lambda: fast(**given))()
            fixed["torch.compile"] = no_grad(lambda: fast(**given))
        except Exception as error:  # a compiler may be missing, or fail: it is left out
            notes["torch.compile left out"] = str(error).splitlines()[0][:200]
    files: list[Path] = []
    try:
        wide = ExportParams(output=folder, formats=("onnx",))
        receipt = export_head(checkpoint, "", wide, lambda said: None)
        for name, file in receipt["files"].items():
            notes[f"{name} off by (training std)"] = file["deviation"]["random"]["std"]
            files.append(folder / name)
    except PipelineError as error:
        notes["ONNX left out"] = str(error)
    fed = {name: value.numpy() for name, value in given.items()}

    def ways(threads: int) -> dict[str, Work]:
        sessions = {file.stem: onnx_session(file, threads) for file in files}
        exported = {
            f"ONNX Runtime, {name}": (lambda session=session: session.run(None, fed))
            for name, session in sessions.items()
        }
        return fixed | exported

    return ways, notes


def gpu_ways(checkpoint: PolicyCheckpoint) -> dict[str, Work]:
    """Eager, and replayed from a CUDA graph, which launches every kernel at once."""
    given = one_tick(checkpoint, checkpoint.policy())
    given = {name: value.cuda() for name, value in given.items()}
    head = Head(checkpoint.policy("cuda")).eval()
    act = no_grad(lambda: head(**given))
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            act()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        act()
    return {EAGER: act, "CUDA graph": graph.replay}


def one_tick(checkpoint: PolicyCheckpoint, policy: Policy) -> Inputs:
    """An observation of one tick with all there is, on the CPU."""
    given = random_inputs(checkpoint, policy, 1)
    for stream in ("sensor", "state"):
        given[f"{stream}_valid"].fill_(given[stream].shape[1])
    given["slot_valid"].fill_(True)
    return given


def no_grad(work: Work) -> Work:
    """The work without gradients, as a robot does it."""

    def done() -> object:
        with torch.no_grad():
            return work()

    return done


def percentiles(found: Race) -> dict[str, Any]:
    """Milliseconds of a call of each contender."""
    told: dict[str, Any] = {}
    for name, seconds in found.seconds.items():
        cuts = statistics.quantiles(seconds, n=100, method="inclusive")
        told[name] = {"p50_ms": round(1e3 * cuts[49], 3), "p99_ms": round(1e3 * cuts[98], 3)}
    return told


if __name__ == "__main__":
    main()

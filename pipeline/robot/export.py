"""The head of a checkpoint, all but the vision-language model, as files that run without this code.

`head.onnx` is for ONNX Runtime, `head.pt2` for `torch.export.load`; `receipt.json` has their inputs
and outputs, and how far each is from the policy. Normalisation is inside: physical units in and
out. Features that the store keeps on a basis come in on it: `basis.npy`. The inputs are the fields
of `Observation` that the policy looks at and, where it samples, the standard normal `noise`, so
that a file is a function; the sampler's loop is unrolled. The batch is of any size, windows are
those of the params. Guides (`rtc`) differentiate the head, which neither format does.
"""

import json
import logging
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from pipeline.base.config import ExportParams
from pipeline.base.errors import ConfigError, NumericsError
from pipeline.base.files import OutputKind, replace_folder, sha256_of, write_document
from pipeline.base.observation import Observation
from pipeline.base.projection import Basis, group_sizes
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.expert import Chunk
from pipeline.policy.observation import AGES, VALIDITY
from pipeline.policy.policy import Policy

RECEIPT, CONTRACT, BASIS = "receipt.json", "contract.json", "basis.npy"
EXPORT = OutputKind("an exported head", lambda folder: (folder / RECEIPT).is_file())

OPSET = 20
"""ONNX operator set."""
TOLERANCE = 1e-4
"""Largest deviation of a file, in training std of the action. Every runtime sums in another order:
sums of n terms then differ by about sqrt(n) 6e-8 of their size, which for the widest layers (n of
some thousands) is 3e-6 a layer, and a few 1e-5 behind some ten layers and the steps of a sampler. A
wrong translation is off by far more."""

_PACKAGES = ("onnx", "onnxscript", "onnxruntime")
_INPUTS = {
    "features": ("", "of the vision-language model, row by slot"),
    "slot_valid": ("", "which slots of the features are real"),
    "feature_age": ("s", "since the newest frame that the features have seen"),
    "view_age": ("s", "since the frame of each view that they have seen, NaN of a missing view"),
    "valid": ("", "how many readings are real, the last ones of the window; 0: it is missing"),
    "age": ("s", "since each reading, 0 where it is not real"),
    "noise": ("", "standard normal, in the order in which the sampler draws it"),
}

Inputs = dict[str, Tensor]
"""Tensors of the fields of `Observation` that a policy looks at, in their order, and `noise`."""

ROWS = 16
_OLD_S = 30.0
"""Age of the oldest features among the random inputs."""
_TURN = {"deg": 5.0, "rad": 0.1, "rotation": 5.0}
"""Standard deviation of the random angles, by kind, in the kind's unit."""

Runner = Callable[[Inputs], NDArray[np.float32]]


class Head(nn.Module):
    """A policy's `act` as a function of the tensors that it looks at."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(
        self,
        *,
        features: Tensor | None = None,
        slot_valid: Tensor | None = None,
        feature_age: Tensor | None = None,
        view_age: Tensor | None = None,
        sensor: Tensor | None = None,
        sensor_valid: Tensor | None = None,
        sensor_age: Tensor | None = None,
        state: Tensor | None = None,
        state_valid: Tensor | None = None,
        state_age: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Chunk:
        """Chunks (batch, horizon, action) in physical units; `noise` is (batch, draw, …)."""
        # Each field is named here, because the inputs of a graph take the names of arguments.
        seen = cast(Observation, SimpleNamespace(**locals()))
        return self.policy.act(seen, None if noise is None else iter(noise.unbind(1)))


def export_head(
    checkpoint: PolicyCheckpoint, folder: str, params: ExportParams, say: Callable[[str], None]
) -> dict[str, Any]:
    """Write the head of `checkpoint`, which lies in `folder`, to `params.output`; its receipt.

    Nothing is written unless every file agrees with the policy. Raises `NumericsError` where one
    does not, `ConfigError` where packages are missing.
    """
    packages = _PACKAGES if "onnx" in params.formats else ()
    if packages:
        _check_packages()
    policy = checkpoint.policy()
    head = Head(policy).eval().requires_grad_(False)
    given = golden_inputs(checkpoint, policy)
    versions = {name: version(name) for name in ("torch", *packages)}
    written_by = {"opset": OPSET, "versions": versions}
    contract = describe(checkpoint, folder, given["random"]) | written_by
    files: dict[str, Any] = {}

    def write(place: Path) -> None:
        say("tracing the head")
        few = {name: value[:2] for name, value in given["random"].items()}  # the file keeps them
        program = trace(head, few)
        if "torch" in params.formats:
            path, extra = place / "head.pt2", {CONTRACT: json.dumps(contract)}
            torch.export.save(program, path, extra_files=extra)
            files[path.name] = _compare(path, torch_runner(path), head, given, checkpoint)
        if "onnx" in params.formats:
            say("translating it to ONNX")
            write_onnx(program, few, path := place / "head.onnx", contract)
            files[path.name] = _compare(path, onnx_runner(path), head, given, checkpoint)
        if (basis := _basis(checkpoint, few)) is not None:
            np.save(place / BASIS, basis.maps)
        write_document(place / RECEIPT, contract | {"files": files})

    replace_folder(params.output, write, EXPORT)
    return contract | {"files": files}


def _check_packages() -> None:
    """Raise `ConfigError` where a package of ONNX is missing."""
    for name in _PACKAGES:
        try:
            import_module(name)
        except ImportError as error:
            raise ConfigError(
                f"export.formats: onnx needs the package {name}, which cannot be loaded ({error}). "
                "Run pip install 'vla-feature-cache[export]', in a checkout pip install -e "
                "'.[export]', or set export.formats=[torch]."
            ) from None


def trace(head: Head, given: Inputs) -> ExportedProgram:
    """The head as a graph over any batch, without the places in the code that it comes from."""
    batch = Dim("batch", min=1, max=65536)
    shapes = {name: {0: batch} for name in given}
    with _quietly(), torch.no_grad():
        program = torch.export.export(head, (), dict(given), dynamic_shapes=shapes)
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)
    return program


def describe(checkpoint: PolicyCheckpoint, folder: str, given: Inputs) -> dict[str, Any]:
    """The inputs, the outputs and what the head is: all of the receipt but the files."""
    action = checkpoint.source["streams"]["action"]
    outputs = {
        "name": "actions",
        "shape": ["batch", *chunk_size(checkpoint)],
        "dtype": "float32",
        "channels": action["names"],
        "units": action["units"],
        "kind": action["kind"],
    }
    channels = "the model's channels"
    if _basis(checkpoint, given) is not None:
        sizes = group_sizes(checkpoint.source["feature_spec"]["slots"])
        groups = f"groups of {', '.join(map(str, sizes))} slots, in order"
        channels = f"{BASIS}: x @ maps[group, :-1] + maps[group, -1] of the model's x; {groups}"
    return {
        "checkpoint": folder,
        "step": checkpoint.step,
        "model_type": checkpoint.params.model_type,
        "fusion_strategy": checkpoint.params.fusion_strategy,
        "feature_spec_digest": checkpoint.source["feature_spec"]["digest"],
        "action_hz": checkpoint.source["action_hz"],
        "horizon": checkpoint.params.horizon,
        "features_on": channels,
        "inputs": [_input(checkpoint, name, value) for name, value in given.items()],
        "outputs": [outputs],
        "anchored": checkpoint.shape.anchored(action["names"]),
        "relative": checkpoint.shape.relative_to_state(action["names"]),
        "guides": "not exported: real-time chunking (rtc) differentiates the head",
    }


def _basis(checkpoint: PolicyCheckpoint, given: Inputs) -> Basis | None:
    """The basis that the features among the inputs are on; None without one, or without them."""
    return checkpoint.basis if "features" in given else None


def write_onnx(
    program: ExportedProgram, given: Inputs, path: Path, contract: Mapping[str, Any]
) -> None:
    """Write an ONNX file with the contract among its metadata."""
    with _quietly():
        written: Any = torch.onnx.export(
            program,
            kwargs=dict(given),
            dynamo=True,
            verbose=False,
            optimize=False,  # ONNX Runtime does it when it loads the file; here it takes minutes
            output_names=["actions"],
            opset_version=OPSET,
        )
    for node in written.model.graph.all_nodes():
        node.metadata_props.clear()  # places in the code, most of the file otherwise
    written.model.metadata_props[CONTRACT] = json.dumps(contract)
    written.save(path, external_data=False)


def onnx_session(path: Path, threads: int = 0) -> Any:
    """A session of an ONNX file on the CPU; 0 threads mean all cores."""
    runtime: Any = import_module("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3
    return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def onnx_runner(path: Path) -> Runner:
    """Runs an ONNX file."""
    session = onnx_session(path)
    return lambda given: session.run(None, {name: v.numpy() for name, v in given.items()})[0]


def torch_runner(path: Path) -> Runner:
    """Runs a `torch.export` file."""
    with _quietly():
        module: Any = torch.export.load(path).module()
    return lambda given: module(**given).numpy()


def _compare(
    path: Path, run: Runner, head: Head, given: Mapping[str, Inputs], checkpoint: PolicyCheckpoint
) -> dict[str, Any]:
    """The receipt of a file. Raises `NumericsError` where it is too far from the policy."""
    off: dict[str, dict[str, float]] = {}
    for name, inputs in given.items():
        answers = head(**inputs).numpy().astype(np.float64)
        furthest = np.abs(run(inputs) - answers).max(axis=(0, 1))
        std = float((furthest / checkpoint.normalization.action.scale).max())
        off[name] = {"std": std}
        if not std <= TOLERANCE:  # a NaN is too far, too
            raise NumericsError(
                f"{path.name}: expected at most {TOLERANCE:g} training std of the action off the "
                f"policy, found {std:.2g} over {name} inputs. Nothing was written: leave this "
                "format out (export.formats), or try other versions of the packages."
            )
    return {
        "sha256": sha256_of(path),
        "bytes": path.stat().st_size,
        "tolerance_std": TOLERANCE,
        "deviation": off,
    }


@contextmanager
def _quietly() -> Generator[None]:
    """Silence warnings and logs of torch and the packages; writing them is slow, too."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _input(checkpoint: PolicyCheckpoint, name: str, value: Tensor) -> dict[str, Any]:
    """The entry of an input in the receipt."""
    dtype = str(value.dtype).removeprefix("torch.")
    entry: dict[str, Any] = {"name": name, "shape": ["batch", *value.shape[1:]], "dtype": dtype}
    streams = checkpoint.source["streams"]
    if name in AGES:  # sensor, state
        return entry | {"channels": streams[name]["names"], "units": streams[name]["units"]}
    unit, meaning = _INPUTS.get(name) or _INPUTS[name.rpartition("_")[2]]
    of_views = {"channels": streams["views"]} if name == "view_age" else {}
    return entry | {"unit": unit, "meaning": meaning} | of_views


def golden_inputs(checkpoint: PolicyCheckpoint, policy: Policy) -> dict[str, Inputs]:
    """`random` inputs and, where the checkpoint has golden rows, `golden` ones."""
    given = {"random": random_inputs(checkpoint, policy, ROWS)}
    rows = checkpoint.golden
    if rows and "features" in policy.encoders:
        golden = random_inputs(checkpoint, policy, len(rows), seed=1)
        history = checkpoint.shape.history
        features = np.stack([np.tile(row.features, (history, 1)) for row in rows])
        valid = np.stack([np.tile(row.slot_valid, history) for row in rows])
        golden["features"] = torch.from_numpy(features).float()
        golden["slot_valid"] = torch.from_numpy(valid).bool()
        given["golden"] = golden
    return given


def random_inputs(checkpoint: PolicyCheckpoint, policy: Policy, rows: int, seed: int = 0) -> Inputs:
    """Random observations around the training mean, on the CPU, and the noise for them.

    Some windows are full, others half full, of one reading or empty; some features are old, some
    slots and views are missing.
    """
    rng = np.random.default_rng(seed)
    given: dict[str, NDArray[Any]] = {}
    for stream in policy.encoders:
        given[stream] = values = _drawn(checkpoint, stream, rows, rng)
        # Without a state, actions that are relative to it are NaN.
        least = int(stream == "state" and bool(policy.shape.relative))
        readings = rng.choice([least, 1, values.shape[1] // 2, values.shape[1]], rows)
        given[VALIDITY[stream]] = readings
        if stream in AGES:
            reach_s: float = getattr(checkpoint.params, f"{stream}_window_s") or 1.0
            age_s = -np.sort(-rng.uniform(0, reach_s, values.shape[:2]))  # the newest last
            seen = np.arange(values.shape[1]) >= values.shape[1] - readings[:, None]
            given[AGES[stream]] = np.where(seen, age_s, 0)
    if "features" in given:
        given["slot_valid"] = rng.uniform(size=given["features"].shape[:2]) < rng.choice(
            [0, 0.5, 1], (rows, 1)
        )
        age_s = rng.uniform(0, _OLD_S, (rows, max(1, policy.shape.views)))
        given["feature_age"] = age_s.min(axis=1)
        unseen = rng.uniform(size=age_s.shape) < 0.2
        given["view_age"] = np.where(unseen, np.nan, age_s)[:, : policy.shape.views]
    order = [name for name in Observation.__dataclass_fields__ if name in given]
    tensors = {name: torch.from_numpy(given[name]) for name in order}
    if draws := count_draws(policy, tensors):
        tensors["noise"] = torch.from_numpy(rng.normal(size=(rows, draws, *chunk_size(policy))))
    return {name: v.float() if v.is_floating_point() else v for name, v in tensors.items()}


def count_draws(policy: Policy, given: Inputs) -> int:
    """How often the policy draws noise in one call of `act`."""
    rows, drawn = len(next(iter(given.values()))), count()
    noise = (torch.zeros(rows, *chunk_size(policy)) for _ in drawn)
    policy.act(cast(Observation, SimpleNamespace(**given)), noise)
    return next(drawn)


def chunk_size(built: PolicyCheckpoint | Policy) -> tuple[int, int]:
    """The steps and channels of an action chunk."""
    return built.params.horizon, built.shape.action_dim


def _drawn(
    checkpoint: PolicyCheckpoint, stream: str, rows: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Random values (row, slot or reading, channel) of a stream around its training mean."""
    statistics, shape = checkpoint.statistics(stream), checkpoint.shape
    lengths = {"sensor": checkpoint.params.sensor_window, "state": checkpoint.params.state_readings}
    spread = statistics.std
    if stream == "state":
        plain = iter(spread)  # expanded states begin with the plain channels
        spread = np.array([_TURN.get(kind) or next(plain) for kind in shape.kinds])
    mean = checkpoint.typical(stream)
    if stream == "features":
        spread = np.tile(spread, (shape.history, 1))
    size = mean.shape if stream == "features" else (lengths[stream], *mean.shape)
    return mean + spread * rng.standard_normal((rows, *size))

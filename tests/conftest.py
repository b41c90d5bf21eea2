"""What tests of every room share: the real recordings, where present, and a small store."""

import os

# Before anything imports numpy or torch, and for every process that a test starts. Sums over
# several threads are taken in another order, so that bits differ; and two processes of one thread
# each do in half of the time what one of two threads does.
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
os.environ |= THREADS

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, redirect_stdout
from importlib.util import find_spec
from io import StringIO
from multiprocessing import forkserver, get_context
from multiprocessing.context import ForkServerContext
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import numpy as np
import pytest
import torch
import yaml
from beartype import beartype
from hypothesis import HealthCheck, settings
from jaxtyping import AbstractArray, install_import_hook

ROOT = Path(__file__).resolve().parents[1]


# By no clock: on a busy machine an example may wait for the processor for seconds.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

SCHEDULED = os.sched_getscheduler(0), os.sched_getparam(0)


@pytest.fixture(autouse=True)
def scheduled_as_before() -> Iterator[None]:
    """libsvtav1 puts the thread that encodes before all other processes, where it has the right to
    (SCHED_FIFO 99), for good: what that thread starts later then keeps all others waiting."""
    os.sched_setscheduler(0, *SCHEDULED)
    yield
    os.sched_setscheduler(0, *SCHEDULED)


def check_shapes(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, checking those of its annotations that name a shape; pyright has the rest."""
    shapes = {name: hint for name, hint in function.__annotations__.items() if names_shape(hint)}
    function.__annotations__ = shapes
    return beartype(function) if shapes else function


def names_shape(hint: Any) -> bool:
    """Whether a type is that of tensors of a shape, or holds such a type."""
    named = isinstance(hint, type) and issubclass(hint, AbstractArray)
    return named or any(map(names_shape, get_args(hint)))


# Before anything imports them: every shape that an annotation names is checked in tests. The hook
# imports the checker by its name, and a conftest has none.
sys.modules["shape_checks"] = ModuleType("shape_checks")
sys.modules["shape_checks"].check_shapes = check_shapes  # type: ignore
install_import_hook(
    [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sorted(ROOT.glob("pipeline/**/*.py"))
        if re.search(r"jaxtyping|policy\.tensors import", path.read_text(encoding="utf-8"))
    ],
    "shape_checks.check_shapes",
)

from pipeline.base.config import load_params
from pipeline.base.errors import ConfigError
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.meta_world import MetaWorldEnvironment
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import SCHEMA, FeatureStore, Sizes, StoreBuild, arrays, schema
from pipeline.store.chunks import ChunkFiles, read_rows, row_checksums, write_seal
from pipeline.store.golden_rows import GoldenFrames, write_golden
from pipeline.store.paths import read_attributes
from pipeline.store.schema import read_specs

# A shell that runs tests in the background has them ignore Ctrl-C, and so would every process that
# they start to see it stop.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Where something has imported it before.
torch.set_num_threads(1)

MOST_WORKERS = 8
"""Processes that run tests at a time: each of them may take two gigabytes."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """In how many processes `-n auto` runs tests: as many as this one may use cores.

    None beside this one for the tests of one file, which would wait longer for the processes than
    they take, and for those that share the one GPU.
    """
    named = {argument.partition("::")[0] for argument in config.option.file_or_dir}
    on_gpu = re.search(r"(?<!not )\bgpu\b", config.option.markexpr) is not None
    if on_gpu or (len(named) == 1 and all(name.endswith(".py") for name in named)):
        return 0
    return min(MOST_WORKERS, len(os.sched_getaffinity(0)))


MODEL = "transformers.models.qwen2_5_vl.modeling_qwen2_5_vl"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings beside the project; a user's machine has none."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}")
    return folder


@pytest.fixture(scope="session")
def tiny_store(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """`tiny_store(folder, ...)`: a copy of a small finished store, written once for all tests.

    The action follows from the features (first two channels), the newest sensor reading (third)
    and the newest state (fourth), so that a policy has something to learn from each.
    """
    originals: dict[tuple[Any, ...], Path] = {}

    def copied(folder: Path, *, name: str = "tiny", **changed: Any) -> Path:
        key = (name, schema.CHUNK_BYTES, *sorted(changed.items()))
        if key not in originals:
            place = tmp_path_factory.mktemp("original")
            originals[key] = write_tiny_store(place, name=name, **changed)
        return Path(shutil.copytree(originals[key], folder / f"{name}.zarr"))

    return copied


@pytest.fixture(scope="session")
def tiny_golden(
    tiny_store: Callable[..., Path], reseal: Callable[[Path], None]
) -> Callable[..., Path]:
    """`tiny_golden(folder, rows=(0, 7), ...)`: a `tiny_store` whose rows `rows` are golden."""

    def made(folder: Path, rows: tuple[int, ...] = (0, 7), **changed: Any) -> Path:
        path, rng = tiny_store(folder, **changed), np.random.default_rng(len(rows))
        frames = [{"View1": rng.integers(0, 256, (6, 8, 3), np.uint8)} for _ in rows]
        golden = [
            GoldenFrames(row, "say: touch the dot", views)
            for row, views in zip(rows, frames, strict=True)
        ]
        spec = read_attributes(path).raw["feature_spec"]
        count = read_specs(path)["vl/key"].shape[0]
        keys = np.memmap(path / "vl/key/c/0/0", np.uint8, "r+", shape=(count, 16))
        for one in golden:
            keys[one.row] = np.frombuffer(one.key(spec), np.uint8)
        keys.flush()
        write_golden(path, golden)
        reseal(path)
        return path

    return made


@pytest.fixture(scope="session")
def tiny_head() -> Callable[..., dict[str, Any]]:
    """`tiny_head(folder, key=value, ...)`: the section `train_head` of a policy of a few hundred
    weights that works below this folder and trains in a moment on a tiny store."""

    def section(folder: Path, **changed: Any) -> dict[str, Any]:
        return {
            "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
            "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
            "expert": {"dim": 8, "layers": 1, "heads": 1},
            "sensor_window": 6,
            "state_window": 5,
            "sensor_window_s": 0.075,
            "state_window_s": 0.125,
            "batch_size": 8,
            "max_steps": 3,
            "device": "cpu",
            "output": str(folder / "head"),
            "logs": str(folder / "logs"),
        } | changed

    return section


@pytest.fixture(scope="session")
def reseal() -> Callable[[Path], None]:
    """`reseal(store)` gives what a test planted in a finished store its checksums."""

    def seal(path: Path) -> None:
        specs = read_specs(path)
        sums = row_checksums(read_rows(path, specs["vl/features"]))
        file = path / "vl" / "checksum" / "c" / "0"
        np.memmap(file, np.uint32, "r+", shape=sums.shape)[:] = sums
        for spec in specs.values():
            with closing(ChunkFiles(path, spec)) as files:
                for file in files.paths:
                    os.truncate(file, spec.chunk_bytes)  # a trailer that is there is compared
                files.seal()
        write_seal(path)

    return seal


@pytest.fixture(scope="session")
def fork_server() -> ForkServerContext:
    """Processes of a server that has imported what takes each seconds otherwise."""
    server = get_context("forkserver")
    stages = [f"stages.{name}" for name in ("evaluate", "extract", "store", "train_head")]
    heavy = ["pipeline.extract.engine", "pipeline.extract.dask_cluster", MODEL]
    server.set_forkserver_preload([*stages, *heavy])
    forkserver.ensure_running()  # with these, whoever forks next
    return server


@pytest.fixture(scope="session")
def hold_together() -> Callable[[FeatureStore], None]:
    """`hold_together(store)`: its arrays agree, which `verify` leaves to those who build stores."""
    return assert_arrays_agree


def assert_arrays_agree(store: FeatureStore) -> None:
    """Offsets, indices, clocks, numbers and names."""
    for stream, stored in schema.STREAMS.items():
        edges, time = store.array(f"episode/{stream}_start"), store.array(f"{stream}/time")
        assert (edges[0], edges[-1]) == (0, len(time)), stream
        for episode in store.episodes:
            rows = getattr(episode, stored.rows)
            assert (np.diff(time[rows.start : rows.stop]) >= 0).all(), stream
    for episode in store.episodes:
        ticks = slice(episode.ticks.start, episode.ticks.stop)
        rows = episode.vl_rows.start + np.arange(len(episode.ticks)) // store.vlm_reuse_count
        assert np.array_equal(store.array("tick/vl_row")[ticks], rows)
        assert len(episode.vl_rows) == -(-len(episode.ticks) // store.vlm_reuse_count)
        for stream in ("sensor", "state"):
            ends = store.array(f"tick/{stream}_end")[ticks]
            readings = getattr(episode, schema.STREAMS[stream].rows)
            assert (np.diff(ends) >= 0).all()
            assert ((ends >= readings.start) & (ends <= readings.stop)).all()
    widths = {"action": store.action_dim, "sensor": store.sensor_channels, "state": store.state_dim}
    assert {stream: len(store.streams[stream]["names"]) for stream in widths} == widths
    assert len(store.streams["views"]) == store.array("vl/frame_time").shape[1]
    for name in ("tick/action", "sensor/values", "state/values"):
        assert np.isfinite(store.array(name)).all(), name


def write_tiny_store(
    folder: Path,
    *,
    name: str = "tiny",
    episodes: int = 6,
    ticks: int = 30,
    slots: int = 3,
    dim: int = 8,
    sensor_channels: int = 5,
    state_dim: int = 4,
    reuse: int = 3,
    readings_a_tick: int = 8,
    states_a_tick: int = 4,
    dtype: str = "float32",
    spec_digest: str = "tiny-spec",
    seed: int = 0,
) -> Path:
    """Episodes of equal length from two sources, `left` and `right`, in turn."""
    rng = np.random.default_rng(seed)
    rows = -(-ticks // reuse)
    readings = ticks * readings_a_tick if sensor_channels else 0
    states = ticks * states_a_tick if state_dim else 0
    said = [
        json.dumps(
            {
                "id": f"episode_{index:03d}",
                "path": f"recordings/episode_{index:03d}",
                "format": "new",
                "instruction": "touch the dot",
                "content": f"{seed}-{index}",
                "digest": f"{seed}-{index}",
            }
        ).encode()
        for index in range(episodes)
    ]
    action_names = ["dx", "dy", "dz", "da", "gripper"]
    streams = {
        "action": {
            "names": action_names,
            "units": ["mm", "mm", "mm", "deg", ""],
            "kind": "delta",
        },
        "sensor": _named("sensor", sensor_channels),
        "state": _named("joint", state_dim),
        "views": ["View1"],
    }
    count = episodes
    sizes = Sizes(
        episode=count,
        tick=count * ticks,
        vl_row=count * rows,
        sensor_reading=count * readings,
        state_reading=count * states,
        byte=sum(map(len, said)),
        slot=slots,
        dim=dim,
        view=1,
        action_dim=len(action_names),
        channel=sensor_channels,
        state_dim=state_dim,
    )
    target = folder / f"{name}.zarr"
    build = StoreBuild(target, arrays(sizes, dtype, "float32"), plan=f"{name}-{seed}")
    build.create()
    build.allocate()

    features = rng.normal(size=(count * rows, slots, dim)).astype(np.float32)
    sensor = rng.normal(size=(count * readings, sensor_channels)).astype(np.float32)
    state = rng.normal(size=(count * states, state_dim)).astype(np.float32)
    tick = np.arange(count * ticks)
    episode, inside = np.divmod(tick, ticks)
    vl_row = episode * rows + inside // reuse
    sensor_end = episode * readings + (inside + 1) * readings_a_tick * bool(readings)
    state_end = episode * states + (inside + 1) * states_a_tick * bool(states)
    action = np.zeros((len(tick), len(action_names)), np.float32)
    action[:, :2] = features[vl_row, 0, :2]
    if readings:
        action[:, 2] = sensor[sensor_end - 1, 0]
    if states:
        action[:, 3] = state[state_end - 1, 0]
    action[:, 4] = 1

    def clock(rows_each: int) -> np.ndarray:
        return np.tile(np.arange(rows_each) * 0.1 * ticks / max(1, rows_each), count)

    edges = np.arange(count + 1)
    contents = {
        "tick/time": clock(ticks),
        "tick/action": action,
        "tick/vl_row": vl_row,
        "tick/sensor_end": sensor_end,
        "tick/state_end": state_end,
        "sensor/values": sensor,
        "sensor/time": clock(readings),
        "state/values": state,
        "state/time": clock(states),
        "vl/slot_valid": np.ones((count * rows, slots), np.uint8),
        "vl/time": clock(ticks)[::reuse][: count * rows] if ticks % reuse == 0 else clock(rows),
        "vl/frame_time": np.tile(np.arange(rows) * 0.1 * reuse - 0.02, count)[:, None],
        "episode/tick_start": edges * ticks,
        "episode/vl_start": edges * rows,
        "episode/sensor_start": edges * readings,
        "episode/state_start": edges * states,
        "episode/text_start": np.cumsum([0, *map(len, said)]),
        "episode/source": np.arange(count) % 2,
        "episode/text": np.frombuffer(b"".join(said), np.uint8),
    }
    for array, values in contents.items():
        build.write(array, 0, np.asarray(values))
    said_of_slots = [{"layer": 0, "norm": True, "pooling": "mean"}] * slots
    build.finish_layout(
        {
            "schema": SCHEMA,
            "slots": said_of_slots,
            "feature_spec": {
                "digest": spec_digest,
                "prompt": "{instruction}",
                "views": ["View1"],
                "slots": said_of_slots,
                "dim": dim,
                "compute_dtype": "float32",
                "storage_dtype": dtype,
            },
            "sources": ["left", "right"],
            "streams": streams,
            "action_hz": 10.0,
            "vlm_reuse_count": reuse,
            "environment": [],
        },
        {"slots": said_of_slots},
    )
    keys = [rng.bytes(16) for _ in range(len(features))]
    stored = features
    if dtype == "bfloat16":
        stored = (features.view(np.uint32) >> 16).astype(np.uint16)
    build.commit(
        np.arange(len(features)),
        stored.astype(build.specs["vl/features"].dtype),
        keys,
        build.environment_index({"torch": "test"}),
    )
    build.seal()
    return target


def _named(prefix: str, width: int) -> dict[str, list[str]]:
    return {"names": [f"{prefix}_{index}" for index in range(width)], "units": [""] * width}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A tmpfs of 8 MiB; needs the right to mount one."""
    place = tmp_path / "small_disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(place)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small file system cannot be mounted here (needs root)")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.fixture(scope="session")
def demo_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small Qwen2.5-VL of the demo."""
    # transformers takes seconds to import, which most tests do without.
    from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

    folder = tmp_path_factory.mktemp("checkpoint") / "demo_vlm"
    write_demo_checkpoint(folder)
    return folder


@pytest.fixture(scope="session")
def trained_once(
    tmp_path_factory: pytest.TempPathFactory,
    demo_checkpoint: Path,
    tiny_head: Callable[..., dict[str, Any]],
) -> Path:
    """A params.yaml whose head is trained on two recordings of the phantom; beside it what was
    made, not to be written to."""
    from stages import extract, train_head

    folder = tmp_path_factory.mktemp("phantom")
    for seed in (5, 6):
        write_raw(folder / "raw" / "task", simulate_episode(seed, 1.7e9 + 100 * seed))
    document = {
        "data": {"root": str(folder), "sources": [{"name": "raw", "path": "raw"}]},
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "image_resize_height": 56,
            "image_resize_width": 84,
            "dtype": "float32",
            "pooling": ["mean", "grid"],
        },
        "extract": {"store": str(folder / "store.zarr")},
        "train_head": tiny_head(folder),
        "rollout": {"episodes": 2, "output": str(folder / "rollout")},
        "serve": {"port": 0, "device": "cpu"},
    }
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    for stage in (extract, train_head):
        with redirect_stdout(StringIO()):
            stage.main(load_params(path))
    return path


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one raw recording in it, not to be written to."""
    folder = tmp_path_factory.mktemp("lab") / "raw"
    write_raw(folder, simulate_episode(4, 1.767e9 + 0.25))
    return folder


@pytest.fixture(scope="session")
def missing() -> Callable[[str], None]:
    """`missing(said)` skips; where CI runs, it fails: a green CI has looked."""

    def stop(said: str) -> None:
        if os.environ.get("CI"):
            pytest.fail(said)
        pytest.skip(said)

    return stop


@pytest.fixture(scope="session")
def meta_world(missing: Callable[[str], None]) -> None:
    """Meta-World, and what draws its frames."""
    if find_spec("metaworld") is None:
        pytest.skip("needs the extra `metaworld`")
    try:
        MetaWorldEnvironment("hammer", image=64)
    except ConfigError as error:
        missing(str(error))


# One a module, not one a session: while playwright runs, no other test can run an event loop.
@pytest.fixture(scope="module")
def browser(missing: Callable[[str], None]) -> Iterator[Any]:
    """Headless Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api")
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        missing(f"no browser to look at pages with: none of {', '.join(BROWSERS)} is installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()

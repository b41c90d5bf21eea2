"""Stage one on dask workers: the same store, whatever dies on the way."""

import asyncio
import json
import math
import os
import pickle
import re
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.context import ForkServerContext
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import dask
import numpy as np
import pytest
from distributed import LocalCluster, Security, rpc

from pipeline.base import errors
from pipeline.base.digests import ContentDigests, file_digest, ledger_path
from pipeline.base.errors import ConfigError, PipelineError, RecordingError, VLMError
from pipeline.extract.dask_cluster import ExtractionPlugin, connected
from pipeline.extract.survey import Survey, survey
from pipeline.store import FeatureStore, StoreBuild
from pipeline.vlm.feature_spec import feature_spec
from tests.extract.conftest import assert_same, missing_of, run

BATCH = 4
PATIENCE_S = 200
"""For what takes seconds, on a machine that does much else."""
PRELOADED = """
import os, signal, threading, time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from pipeline.base.errors import NumericsError
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import RowPreparation
from pipeline.extract.dask_cluster import ExtractionPlugin

control = Path({control!r})
prepare, encode, begin = RowPreparation.prepare, Encoder.encoded, ExtractionPlugin.setup
one_at_a_time = threading.Lock()

def setup(self, worker, begin=begin):
    with suppress(FileNotFoundError):
        (control / "kill-at-setup").unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    begin(self, worker)

def prepared(self, rows, firsts, prepare=prepare):
    name = Path(rows.recording.path).name
    with (control / "tried").open("a") as log:
        log.write(f"{{name}}\\n")
    if (control / f"raises-{{name}}").exists():
        raise ValueError(f"a frame of {{name}} cannot be read")
    if (control / f"kills-{{name}}").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    return prepare(self, rows, firsts)

def encoded(self, rows, encode=encode):
    for batch, features in encode(self, rows):
        note([one.row for one in batch])
        for one in batch:
            name = Path(one.where.split(",")[0]).name
            if (control / f"nan-{{name}}").exists():
                raise NumericsError(f"{{one.where}}: expected finite features")
        yield batch, features

def note(rows):
    # Other threads compute on meanwhile, but what they have noted is on its way to be marked.
    with one_at_a_time:
        before = rows_by_process()[os.getpid()]
        with (control / "computed").open("a") as log:
            log.write(" ".join(map(str, (os.getpid(), *rows))) + "\\n")
        if (control / "kill").exists() and before:
            wait_until(lambda: before <= set(map(int, (control / "marked").read_text().split())))
            with suppress(FileNotFoundError):  # another was first
                (control / "kill").unlink()
                os.kill(os.getpid(), signal.SIGKILL)

def rows_by_process():
    found = defaultdict(set)
    with suppress(FileNotFoundError):  # the first
        for line in (control / "computed").read_text().splitlines():
            process, *rows = map(int, line.split())
            found[process] |= set(rows)
    return found

def wait_until(true):
    deadline = time.monotonic() + 100
    while not true() and time.monotonic() < deadline:
        time.sleep(0.02)

if prepare.__module__ == RowPreparation.__module__:  # a worker may run this twice
    RowPreparation.prepare, Encoder.encoded, ExtractionPlugin.setup = prepared, encoded, setup
"""
"""Run by each worker as it starts: it notes what it does, and does what the tests ask for."""


@dataclass(frozen=True)
class Workers:
    """A cluster of two processes that notes what it computes."""

    cluster: LocalCluster
    control: Path

    @property
    def address(self) -> str:
        return self.cluster.scheduler_address

    def ask(self, what: str) -> None:
        (self.control / what).touch()

    def computed(self) -> tuple[Counter[int], set[int]]:
        """How often the model was given each row, and the processes that did."""
        lines = [line.split() for line in self._lines("computed")]
        return Counter(int(row) for line in lines for row in line[1:]), {
            int(line[0]) for line in lines
        }

    def tried(self) -> Counter[str]:
        """How often a piece of each episode was begun."""
        return Counter(self._lines("tried"))

    def forget(self) -> None:
        for path in self.control.iterdir():
            path.unlink()

    def _lines(self, name: str) -> list[str]:
        path = self.control / name
        return path.read_text().splitlines() if path.exists() else []


@pytest.fixture(scope="module")
def forked(fork_server: ForkServerContext) -> Iterator[None]:
    """Local workers are forked: begun anew, each would import for seconds, as it does for users and
    in the processes that `begin` begins."""
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        yield


@pytest.fixture(scope="module")
def two_workers(forked: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workers]:
    control = tmp_path_factory.mktemp("control")
    preload = tmp_path_factory.mktemp("preload") / "noting.py"
    preload.write_text(PRELOADED.format(control=str(control)))
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})
    with (
        patient,
        LocalCluster(
            n_workers=2,
            threads_per_worker=2,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            silence_logs=50,
            scheduler_kwargs={"allowed_failures": 0},
            preload=str(preload),
        ) as cluster,
    ):
        yield Workers(cluster, control)


@pytest.fixture
def workers(two_workers: Workers) -> Workers:
    two_workers.cluster.wait_for_workers(2, timeout=PATIENCE_S)  # one that was killed comes back
    two_workers.forget()
    return two_workers


@pytest.fixture
def here(extracted_once) -> FeatureStore:
    """The store that this process makes of the same recordings."""
    return FeatureStore.open(extracted_once)


def reached_by_others(address: str) -> bool:
    """Whether dask at this address answers someone with a certificate of their own."""

    async def answered() -> bool:
        own = Security.temporary().get_connection_args("client") | {"require_encryption": False}
        async with rpc(address, timeout=2, connection_args=own) as other:
            return bool(await other.identity())

    with suppress(OSError):
        return asyncio.run(asyncio.wait_for(answered(), 2))
    return False


class TestStore:
    def test_equals_that_of_one_process(self, changed, workers, here):
        params = changed(extract={"workers": workers.address})
        report = run(params)[0]
        assert report.computed == report.rows == len(here.array("vl/time"))
        assert_same(FeatureStore.open(params.extract.store), here)
        golden = FeatureStore.open(params.extract.store).golden
        assert [row.key for row in golden] == [row.key for row in here.golden]
        times, processes = workers.computed()
        assert set(times.values()) == {1}
        assert len(processes) == 2

    def test_rows_of_known_frames_are_taken_over_in_the_workers(self, changed, recordings, workers):
        params = changed(extract={"workers": workers.address})
        run(params)
        before = FeatureStore.open(params.extract.store).array("vl/features").copy()
        for path in recordings.rglob("metadata.json"):
            path.write_text(path.read_text() + "\n")  # other files, the same frames
        workers.forget()
        report = run(params)[0]
        assert (report.computed, report.taken) == (0, report.rows)
        assert not workers.computed()[0]
        store = FeatureStore.open(params.extract.store)
        assert np.array_equal(store.array("vl/features"), before)
        assert "torch" in store.attrs["environment"][0]


class TestDeaths:
    @pytest.mark.slow
    def test_a_killed_worker_loses_one_batch(self, changed, workers, tmp_path, monkeypatch):
        def noted(self, rows, *args, mark=StoreBuild.mark):
            mark(self, rows, *args)
            with (workers.control / "marked").open("a") as log:
                log.write(" ".join(map(str, (*rows, ""))))

        pages = {"layers": [-1, 1]}  # a row fills a page, so that no task has two batches
        expected = changed(vlm=pages, extract={"store": str(tmp_path / "expected.zarr")})
        run(expected)
        monkeypatch.setattr(StoreBuild, "mark", noted)
        workers.ask("marked")
        workers.ask("kill")  # one that computes when all that it did before is marked
        params = changed(vlm=pages, extract={"workers": workers.address})
        run(params)
        stores = [FeatureStore.open(made.extract.store) for made in (params, expected)]
        assert_same(*stores)
        times, _ = workers.computed()
        assert 1 <= times.total() - len(times) <= BATCH

    def test_poisoned_recordings_are_reported_when_all_others_are_done(
        self, changed, recordings, write_episode, workers, tmp_path
    ):
        write_episode(recordings / "Touch_dot" / "episode_4", 4)
        workers.ask("raises-episode_1")
        workers.ask("kills-episode_3")
        workers.ask("nan-episode_4")
        params = changed(extract={"workers": workers.address, "retries": 1})
        with pytest.raises(RecordingError, match="3 episodes could not be computed") as raised:
            run(params)
        said = str(raised.value)
        assert "a frame of episode_1 cannot be read" in said
        deaths = said.count("every worker died that computed them alone")
        assert deaths == 1, "its neighbour is not blamed"
        assert "episode_4, VL row" in said
        tried = workers.tried()
        # Of two ranges: a death may take one away before it begins, or its answer with it.
        assert 1 <= tried["episode_1"] <= 6
        assert 2 <= tried["episode_3"] <= 4
        done = set(workers.computed()[0])
        missing = missing_of(params.extract.store)
        workers.forget()
        run(params)
        store = FeatureStore.open(params.extract.store)
        rows = {Path(one.id).name: set(one.vl_rows) for one in store.episodes}
        assert not missing & rows["episode_2"]
        for name in ("episode_1", "episode_3", "episode_4"):
            assert missing >= rows[name]
        times, _ = workers.computed()
        assert set(times) == missing
        assert set(times.values()) == {1}
        assert done - missing
        expected = changed(extract={"store": str(tmp_path / "expected.zarr")})
        run(expected)
        assert_same(store, FeatureStore.open(expected.extract.store))


class TestRefusals:
    def test_a_model_that_cannot_be_loaded_stops_at_once(self, changed, workers):
        params = changed(
            vlm={"attention": "flash_attention_2"}, extract={"workers": workers.address}
        )
        with pytest.raises(VLMError, match="flash_attention_2 needs CUDA"):
            run(params)
        assert max(workers.tried().values()) <= 4, "no range is tried again"

    @pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "tls://127.0.0.1:9"])
    def test_a_wrong_address(self, changed, monkeypatch, address):
        monkeypatch.setattr("pipeline.base.scheduler.TIMEOUT_S", 1)
        wrong = changed(extract={"workers": address})
        with pytest.raises(ConfigError, match="no dask scheduler answers at"):
            run(wrong)

    def test_a_worker_elsewhere(self, params, monkeypatch):
        spec = feature_spec(params.vlm, params.extract.dtype, ["View1", "View2"], file_digest)
        elsewhere = params.extract.model_copy(update={"workers": "tcp://elsewhere:8786"})
        sections = params.data, params.vlm, elsewhere
        surveyed = Survey(*sections, (), (), (), spec, "rotvec", "plan")
        plugin = ExtractionPlugin(surveyed, ())
        with pytest.raises(ConfigError, match=r"finds no build .*made\.zarr\.part"):
            plugin.check_place()
        monkeypatch.setattr("pipeline.extract.dask_cluster.read_plan", lambda part: "plan")
        plugin.check_place()
        other_vlm = params.vlm.model_copy(update={"layers": (0,)})
        other = ExtractionPlugin(replace(surveyed, vlm=other_vlm), ())
        with pytest.raises(ConfigError, match="would compute other features"):
            other.check_place()

    def test_local_workers_take_turns_over_the_gpus(self, changed, monkeypatch):
        monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
        for wanted, workers, name, device in (
            ("auto", 4, 3, "cuda:1"),
            ("cuda", 4, 0, "cuda:0"),
            ("cuda:0", 4, 3, "cuda:0"),
            ("auto", "tcp://a:1", 3, "auto"),
        ):
            params = changed(extract={"device": wanted, "workers": workers})
            sections = params.data, params.vlm, params.extract
            surveyed = Survey(*sections, (), (), (), None, "rotvec", "")  # type: ignore[arg-type]
            assert ExtractionPlugin(surveyed, ()).device_of(name) == device

    def test_errors_survive_the_way_from_a_worker(self):
        named = (value for value in vars(errors).values() if isinstance(value, type))
        kinds = [kind for kind in named if issubclass(kind, PipelineError)]
        assert len(kinds) > 8
        for kind in kinds:
            back = pickle.loads(pickle.dumps(kind("what, where, what to run")))
            assert type(back) is kind
            assert str(back) == "what, where, what to run"


class TestScheduler:
    @pytest.mark.slow
    def test_a_killed_scheduler_is_said_and_the_next_run_completes(
        self, changed, here, tmp_path, monkeypatch, begin
    ):
        address_file = tmp_path / "scheduler.json"
        options = ["--scheduler-file", str(address_file)]
        listening = "--port", "0", "--no-dashboard", *options
        scheduler = begin(DASK.format(role="scheduler"), tmp_path, *listening)
        worker = begin(DASK.format(role="worker"), tmp_path, *WORKER, *options)
        mark = StoreBuild.mark
        marked: list[int] = []

        def then_killed(self, rows, *args):
            mark(self, rows, *args)
            marked.extend(rows)
            scheduler.kill()

        try:
            while not address_file.exists():
                time.sleep(0.05)
            monkeypatch.setattr(StoreBuild, "mark", then_killed)
            address = json.loads(address_file.read_text())["address"]
            params = changed(extract={"workers": address, "batch_size": 1})
            with pytest.raises(PipelineError, match="workers or their scheduler were lost"):
                run(params)
        finally:
            for process in (scheduler, worker):
                process.kill()
        monkeypatch.setattr(StoreBuild, "mark", mark)
        everything = set(range(len(here.array("vl/time"))))
        assert missing_of(params.extract.store) == everything - set(marked)
        run(changed())
        assert_same(FeatureStore.open(params.extract.store), here)


@pytest.mark.usefixtures("forked")
class TestLocalProcesses:
    def test_nobody_else_reaches_them(self, params):
        extract = params.extract.model_copy(update={"workers": 1, "decode_threads": 1})
        with connected(extract) as client:
            assert client.submit(abs, -1).result() == 1
            known = client.scheduler_info(n_workers=-1)
            (worker, told), scheduler = next(iter(known["workers"].items())), known["address"]
            pages = [known["services"]["dashboard"], told["services"]["dashboard"]]
            for address in (scheduler, worker, told["nanny"]):
                port = address.rpartition(":")[2]
                for way in (f"tcp://127.0.0.1:{port}", address):
                    assert not reached_by_others(way), f"code of others runs at {way}"
            for port in pages:
                with pytest.raises(HTTPError, match="404"):
                    urlopen(f"http://127.0.0.1:{port}/json/identity.json")

    @pytest.mark.slow
    def test_ctrl_c_leaves_no_process_and_the_next_run_with_two_completes(
        self, changed, params_file, begin, here, tmp_path
    ):
        process = begin(STAGE, tmp_path, "--params", str(params_file), *TWO)
        wait_for(lambda: process.stderr.read_text() == "marked\n", process)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait() == 1
        assert process.stderr.read_text() == "marked\nstopped; run the same command again\n"
        assert not left_of_group(process.pid)
        with_workers = changed(extract={"workers": 2, "batch_size": 1})
        store = with_workers.extract.store
        missing = missing_of(store)
        assert missing
        report = run(with_workers)[0]
        assert report.computed == len(missing)
        assert_same(FeatureStore.open(store), here)
        surveyed = survey(with_workers, ContentDigests(ledger_path(store)))
        rate = ContentDigests(ledger_path(store)).rate(surveyed.rate_name)
        assert 0 < rate < math.inf


class TestStart:
    """Of local processes, which takes long enough to be cut short."""

    @pytest.mark.slow
    def test_a_worker_killed_as_it_starts_is_said(self, params_file, begin, tmp_path):
        process = self.begun(begin, params_file, tmp_path)
        (tmp_path / "kill").touch()
        assert process.wait() == 2
        said = process.stderr.read_text()
        assert re.match(r"error: extract.workers: 2 worker processes could not be started", said)
        assert len(said.splitlines()) == 1
        assert not left_of_group(process.pid)

    def test_a_worker_killed_as_it_is_told_what_to_do_is_said(self, changed, workers):
        workers.ask("kill-at-setup")
        with pytest.raises(ConfigError, match=r"extract\.workers: a worker cannot begin"):
            run(changed(extract={"workers": workers.address}))

    @pytest.mark.parametrize(
        "how", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
    )
    def test_stopped_as_workers_start(self, params_file, begin, tmp_path, how):
        process = self.begun(begin, params_file, tmp_path)
        if how == signal.SIGINT:
            os.killpg(process.pid, how)  # as a terminal does
        else:
            os.kill(process.pid, how)
        assert process.wait() == 1
        assert process.stderr.read_text() == "stopped; run the same command again\n"
        assert not left_of_group(process.pid)

    def begun(self, begin, params_file: Path, folder: Path):
        """The command; a worker of it has begun, and will not be up before the test ends."""
        preload = folder / "starting.py"
        preload.write_text(STARTING.format(control=str(folder)))
        code = f"import dask\ndask.config.set({{'distributed.worker.preload': {str(preload)!r}}})\n"
        process = begin(code + STAGE, folder, "--params", str(params_file), *TWO)
        wait_for((folder / "starting").exists, process)
        return process


STAGE = """
import sys, time
from pipeline.store import StoreBuild
from stages.command import run
from stages.extract import main

def mark(self, *args, mark=StoreBuild.mark):
    mark(self, *args)
    print("marked", file=sys.stderr, flush=True)
    time.sleep(600)

StoreBuild.mark = mark
raise SystemExit(run("", main, sys.argv[1:]))
"""
"""The stage, which says when rows are marked and then waits to be stopped."""

STARTING = """
import os, signal, time
from contextlib import suppress
from pathlib import Path

control = Path({control!r})
(control / "starting").touch()
while not (control / "killed").exists():
    with suppress(FileNotFoundError):
        (control / "kill").rename(control / "killed")
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.02)
"""
"""Run by each worker as it starts: it goes no further, until one was asked to kill itself."""

TWO = ("--set", "extract.workers=2")

WORKER = ("--nthreads", "2", "--no-nanny", "--death-timeout", "60", "--no-dashboard")


DASK = "from distributed.cli.dask_{role} import main\nmain()"
"""A process of dask's command line."""


def wait_for(true: Callable[[], bool], process) -> None:
    """Return when something is so; fail where the process ends before."""
    while not true():
        assert process.poll() is None, process.stderr.read_text()
        time.sleep(0.02)


def left_of_group(group: int) -> list[str]:
    """The processes of a process group that do not see that their parent is gone, and end."""
    deadline = time.monotonic() + PATIENCE_S
    while (left := of_group(group)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return list(left.values())


def of_group(group: int) -> dict[int, str]:
    """The processes of a process group that still run, and their commands."""
    found: dict[int, str] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
            if int(fields[2]) == group and fields[0] != "Z":
                found[int(status.parent.name)] = (status.parent / "cmdline").read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found

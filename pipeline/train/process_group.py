"""The processes of one training, a single one or several from torchrun, and how they stop."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from types import FrameType
from typing import Any, Self, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from pipeline.base.errors import ConfigError, PipelineError
from pipeline.base.machine import resolve_device

Outcome = TypeVar("Outcome")

PATIENCE = timedelta(hours=12)
"""How long a process waits for another: the others wait while rank 0 fits the normalisation and
evaluates. Nobody waits for a process that died: torchrun ends the rest."""
AT_ONCE = 32
"""Gradients that are summed over the processes in one call: few calls, little copied."""
PRECEDENCE = timedelta(seconds=5)
"""How long a failing process waits until rank 0, which mostly fails of the same, has reported."""
_REPORTER = "reporter"
FROM_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")


class FirstProcessFailed(PipelineError):
    """Rank 0 has failed and reports why; the other processes only end."""


@dataclass(frozen=True)
class ProcessGroup:
    """This process among all processes of a training: its `rank` in 0..`size` - 1.

    Methods are collective unless they say otherwise: every process calls them in the same order.
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def current(cls) -> Self:
        """The group that this process has joined with `process_group`; else a group of one."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size())
        return cls()

    @property
    def first(self) -> bool:
        """Whether this is the process that logs, evaluates and saves."""
        return self.rank == 0

    def shared(self, work: Callable[[], Outcome]) -> Outcome:
        """Run `work` on rank 0 and return its result, sent by pickle, on every process.

        If `work` fails, rank 0 raises its error and the others raise `FirstProcessFailed`, so that
        none waits.
        """
        if self.size == 1:
            return work()
        sent: list[Any] = [None, None]
        failure: BaseException | None = None
        if self.first:
            try:
                sent[0] = work()
            except BaseException as error:
                failure, sent[1] = error, f"{type(error).__name__}: {error}"
        dist.broadcast_object_list(sent, src=0, device=torch.device("cpu"))
        if failure is not None:
            raise failure
        if sent[1] is not None:
            raise FirstProcessFailed(sent[1])
        return sent[0]

    @contextmanager
    def holding(self, lock: AbstractContextManager[None]) -> Generator[None]:
        """Hold a lock on rank 0 on behalf of all processes."""
        with ExitStack() as held:
            self.shared(lambda: held.enter_context(lock))
            yield

    def say(self, *lines: str) -> None:
        """Print these lines, once for all processes; not collective."""
        if self.first:
            for line in lines:
                print(line, flush=True)

    def sum(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over all processes."""
        if self.size > 1:
            for start in range(0, len(tensors), AT_ONCE):
                bucket = tensors[start : start + AT_ONCE]
                flat = torch.cat([tensor.reshape(-1) for tensor in bucket])
                dist.all_reduce(flat)
                parts = flat.split([tensor.numel() for tensor in bucket])
                for tensor, part in zip(bucket, parts, strict=True):
                    tensor.copy_(part.view_as(tensor))

    def sum_gradients(
        self, parameters: Iterable[nn.Parameter], sums: Mapping[str, Tensor], stop: bool
    ) -> bool:
        """Replace gradients and `sums` by their sums over the processes.

        Returns whether any process passed `stop`. Each process has weighted its parts by their
        share of the whole batch, so the sum is the mean. A parameter that no process used keeps no
        gradient, so the optimizer skips it as in a single process; one that only other processes
        used counts as zero here. All processes end with the same bits.
        """
        if self.size == 1:
            return stop
        parameters = list(parameters)
        flags = torch.tensor([stop, *(p.grad is not None for p in parameters)], dtype=torch.uint8)
        dist.all_reduce(flags, dist.ReduceOp.MAX)
        stop, *used = flags.bool().tolist()
        for parameter, anywhere in zip(parameters, used, strict=True):
            if anywhere and parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        self.sum([*sums.values(), *(p.grad for p in parameters if p.grad is not None)])
        return stop

    def tensors(self, named: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rank 0's tensors, on every process; they are sent one by one."""
        if self.size == 1:
            return dict(named)
        shapes = self.shared(lambda: {name: value.to("meta") for name, value in named.items()})
        received = {n: named.get(n, torch.empty_like(v, device="cpu")) for n, v in shapes.items()}
        self.spread(received.values())
        return received

    def spread(self, tensors: Iterable[Tensor]) -> None:
        """Set each tensor to the value it has on rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


@contextmanager
def process_group(device: str) -> Generator[ProcessGroup]:
    """Join the processes that torchrun started, as the environment says; else a group of one.

    Tensors travel by nccl between CUDA devices and by gloo between CPUs, everything else by gloo.
    Within it one process reports an error (`one_reporter`); the others end silently, with the exit
    code of a stage: 2, or 1 where it was stopped. Raises `ConfigError` where the environment is
    incomplete.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield ProcessGroup()
        return
    missing = [name for name in FROM_TORCHRUN if name not in os.environ]
    if missing:
        raise ConfigError(
            f"WORLD_SIZE is {os.environ['WORLD_SIZE']}, so several processes train together: "
            f"expected {', '.join(FROM_TORCHRUN)} in the environment, {', '.join(missing)} is "
            "missing. Start it with torchrun, or unset WORLD_SIZE."
        )
    store, rank, size = next(dist.rendezvous("env://", timeout=PATIENCE))
    store.set_timeout(PATIENCE)
    group_store = dist.PrefixStore("group", store)
    try:
        with one_reporter(dist.PrefixStore("errors", store), rank):
            resolved = process_device(device)
            if resolved.type == "cuda":
                torch.cuda.set_device(resolved)
            backend = "cpu:gloo,cuda:nccl" if resolved.type == "cuda" else "gloo"
            dist.init_process_group(
                backend, store=group_store, rank=rank, world_size=size, timeout=PATIENCE
            )
            yield ProcessGroup.current()
    finally:
        # Done last: it closes what the others may wait on, and now they know who reports.
        if dist.is_initialized():
            dist.destroy_process_group()


def process_device(name: str) -> torch.device:
    """The device of a `device:` param for this process.

    With several processes on CUDA, each takes the GPU of its LOCAL_RANK. Raises `ConfigError` as
    `resolve_device` does, and if one GPU is named for several processes.
    """
    several = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if several and name.startswith("cuda:"):
        raise ConfigError(
            f"device: {name}: expected auto, cpu or cuda for {os.environ['WORLD_SIZE']} processes, "
            "of which each takes the GPU of its LOCAL_RANK. Set train_head.device=auto."
        )
    if several and (name == "cuda" or (name == "auto" and torch.cuda.is_available())):
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    return resolve_device(name)


@contextmanager
def one_reporter(store: dist.Store, rank: int) -> Generator[None]:
    """Within it, only one process raises an error that a user can mend; the others exit with 2.

    Rank 0 reports if it fails too, else the first process that fails, with its rank in the
    message. Rank 0 also reports a stop, unless torchrun stops all because one process failed.
    `store` is the store of the rendezvous: it needs no other process to answer.
    """
    try:
        yield
    except FirstProcessFailed:
        raise SystemExit(2) from None
    except (PipelineError, OSError) as error:
        if rank > 0:
            with suppress(RuntimeError, KeyboardInterrupt):
                store.wait([_REPORTER], PRECEDENCE)
        # If the store is gone with rank 0, it is better to report an error twice than never.
        with suppress(RuntimeError):
            if store.compare_set(_REPORTER, "", str(rank)) != str(rank).encode():
                raise SystemExit(2) from None
        if rank == 0:
            raise
        raise PipelineError(f"process of rank {rank}: {error}") from error
    except (KeyboardInterrupt, RuntimeError) as error:
        # gloo and NCCL raise a RuntimeError when another process is gone.
        stopped = isinstance(error, KeyboardInterrupt)
        if (stopped and rank > 0) or _is_reported(store):
            raise SystemExit(1 if stopped else 2) from None
        raise


def _is_reported(store: dist.Store) -> bool:
    try:
        return store.check([_REPORTER])
    except RuntimeError:
        return False


@contextmanager
def deferred_interrupt() -> Generator[Callable[[], bool]]:
    """Within it, the first SIGINT or SIGTERM only makes the yielded function return True.

    A step stopped half-way would leave some weights updated and others not, so the loop asks
    between steps. A second signal raises `KeyboardInterrupt` at once. Outside the main thread,
    where Python delivers no signal, it changes nothing.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(signum: int, frame: FrameType | None) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(signum)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

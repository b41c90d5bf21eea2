"""The processes of one training: alone, or several that torchrun started."""

import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Self, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from pipeline.base.device import resolve_device
from pipeline.base.errors import ConfigError
from pipeline.train.speaker import SaidByFirst, one_speaker

Outcome = TypeVar("Outcome")

PATIENCE = timedelta(hours=12)
"""How long a process waits for another: rank 0 fits the normalisation and judges while the others
wait. A process that died is not waited for: torchrun ends the rest."""
BUCKET_BYTES = 32 * 2**20
"""Gradients are summed over the processes this many bytes at a time: few calls, little copied."""
FROM_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class World:
    """This process among all of a training: its `rank` in 0..`size` - 1.

    Its methods are collective, but where said: every process calls them, in the same order.
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def current(cls) -> Self:
        """That of the process group, where there is one (`process_group`); else a single one."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size())
        return cls()

    @property
    def first(self) -> bool:
        """Whether this is the process that logs, judges and saves."""
        return self.rank == 0

    def shared(self, work: Callable[[], Outcome]) -> Outcome:
        """What `work` gives on rank 0, on every process; it is pickled on its way.

        What it raises is raised on rank 0, and `SaidByFirst` on the others, so that none waits.
        """
        if self.size == 1:
            return work()
        said: list[Any] = [None, None]
        failure: BaseException | None = None
        if self.first:
            try:
                said[0] = work()
            except BaseException as error:
                failure, said[1] = error, f"{type(error).__name__}: {error}"
        dist.broadcast_object_list(said, src=0, device=torch.device("cpu"))
        if failure is not None:
            raise failure
        if said[1] is not None:
            raise SaidByFirst(said[1])
        return said[0]

    @contextmanager
    def holding(self, lock: AbstractContextManager[None]) -> Generator[None]:
        """Hold a lock on rank 0, for all."""
        with ExitStack() as held:
            self.shared(lambda: held.enter_context(lock))
            yield

    def say(self, *lines: str) -> None:
        """Print these lines, once for all processes; not collective."""
        if self.first:
            for line in lines:
                print(line, flush=True)

    def any(self, flags: Sequence[bool]) -> list[bool]:
        """Each flag: whether it is set on any process."""
        if self.size == 1:
            return list(flags)
        found = torch.tensor(flags, dtype=torch.uint8)
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return found.bool().tolist()

    def sum(self, tensors: Iterable[Tensor]) -> None:
        """Replace each tensor by its sum over all processes."""
        if self.size > 1:
            for bucket in _buckets(tensors):
                flat = torch.cat([tensor.reshape(-1) for tensor in bucket])
                dist.all_reduce(flat)
                parts = flat.split([tensor.numel() for tensor in bucket])
                for tensor, part in zip(bucket, parts, strict=True):
                    tensor.copy_(part.view_as(tensor))

    def tensors(self, named: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The tensors in memory that rank 0 calls with, on every process, sent one by one."""
        if self.size == 1:
            return dict(named)
        shapes = self.shared(lambda: {name: (v.shape, v.dtype) for name, v in named.items()})
        found = {
            name: named[name] if self.first else torch.empty(shape, dtype=dtype)
            for name, (shape, dtype) in shapes.items()
        }
        self.spread(found.values())
        return found

    def spread(self, tensors: Iterable[Tensor]) -> None:
        """Give each tensor the value it has on rank 0."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


@contextmanager
def process_group(device: str) -> Generator[World]:
    """The world of a run of torchrun, from the environment; of a single process outside of one.

    nccl between CUDA devices, gloo between CPUs and for what concerns no tensor. Within it one
    process alone says what went wrong (`one_speaker`); the others end silently, with the exit code
    of a stage (2, or 1 where it was stopped). Raises `ConfigError` where the environment is
    incomplete.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield World()
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
    met = dist.PrefixStore("group", store)
    try:
        with one_speaker(dist.PrefixStore("errors", store), rank):
            resolved = process_device(device)
            if resolved.type == "cuda":
                torch.cuda.set_device(resolved)
            backend = "cpu:gloo,cuda:nccl" if resolved.type == "cuda" else "gloo"
            dist.init_process_group(
                backend, store=met, rank=rank, world_size=size, timeout=PATIENCE
            )
            yield World.current()
    finally:
        # Last, for it closes what the others may wait on: by then it is known who says why.
        if dist.is_initialized():
            dist.destroy_process_group()


def process_device(name: str) -> torch.device:
    """The device of a `device:` param for this process.

    Several processes on CUDA take the GPU of their LOCAL_RANK each. Raises `ConfigError` as
    `resolve_device` does, and where one GPU is named for several processes.
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


def _buckets(tensors: Iterable[Tensor]) -> Generator[list[Tensor]]:
    """The tensors in their order, neighbours of one dtype together up to `BUCKET_BYTES`."""
    bucket: list[Tensor] = []
    size = 0
    for tensor in tensors:
        if bucket and (tensor.dtype != bucket[0].dtype or size + tensor.nbytes > BUCKET_BYTES):
            yield bucket
            bucket, size = [], 0
        bucket.append(tensor)
        size += tensor.nbytes
    if bucket:
        yield bucket

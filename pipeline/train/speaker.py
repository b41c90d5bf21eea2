"""Of several processes that fail, one says why."""

from collections.abc import Generator
from contextlib import contextmanager, suppress
from datetime import timedelta

import torch.distributed as dist

from pipeline.base.errors import PipelineError

PRECEDENCE = timedelta(seconds=5)
"""How long a process that fails waits for rank 0, which mostly fails of the same, to say so."""
_SPEAKER = "speaker"


class SaidByFirst(PipelineError):
    """Rank 0 has failed and says why; the other processes only end."""


@contextmanager
def one_speaker(store: dist.Store, rank: int) -> Generator[None]:
    """Within it, what the user can mend is raised on one process; the others exit with code 2.

    That one is rank 0 where it fails too, else the first that fails, and its message names its
    rank. A stop is said by rank 0, unless it is torchrun's, which ends all when one has failed.
    `store` is what the processes met at: it needs no other process to answer.
    """
    try:
        yield
    except SaidByFirst:
        raise SystemExit(2) from None
    except (PipelineError, OSError) as error:
        if not _speaks(store, rank):
            raise SystemExit(2) from None
        if rank == 0:
            raise
        raise PipelineError(f"process of rank {rank}: {error}") from error
    except KeyboardInterrupt:
        if rank > 0 or _spoken(store):
            raise SystemExit(1) from None
        raise
    except RuntimeError:
        # As gloo and NCCL say that another process is gone.
        if _spoken(store):
            raise SystemExit(2) from None
        raise


def _speaks(store: dist.Store, rank: int) -> bool:
    """Whether this process, of those that have failed, says so."""
    try:
        if rank > 0:
            with suppress(dist.DistStoreError, KeyboardInterrupt):
                store.wait([_SPEAKER], PRECEDENCE)
        return store.compare_set(_SPEAKER, "", str(rank)) == str(rank).encode()
    except RuntimeError:
        # Rank 0 held the store and is gone: an error is rather said twice than never.
        return True


def _spoken(store: dist.Store) -> bool:
    try:
        return store.check([_SPEAKER])
    except RuntimeError:
        return False

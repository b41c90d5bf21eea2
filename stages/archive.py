"""Make a small copy of a store for keeping and sharing, or the store from such a copy.

The archive is a plain zarr v3 group with the same arrays under the same names: compressed, in few,
large files, every piece of them checksummed. Each array's codec is the one that makes the least of
samples of that very array. --restore gives back the store, equal in every byte; what is damaged in
an archive is named and never restored.

  python -m stages.archive                       extract.store -> <its name>.archive.zarr beside it
  python -m stages.archive --restore             the store from that archive
  python -m stages.archive --set archive.level=15                     smaller, and much slower
  python -m stages.archive --restore --set archive.store=copy.zarr --set archive.output=a.zarr
                                                 copy.zarr from the archive a.zarr
"""

from stages.command import Shorthand, run

RESTORE = Shorthand("--restore", "archive.restore", "make the store from its archive")

if __name__ == "__main__":  # here, for --help waits for no import below
    raise SystemExit(
        run(__doc__ or "", "stages.archive", shorthands=[RESTORE], sections=("archive",))
    )

import time
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.store.archive import archive, restore


def main(params: Params) -> None:
    """Archive or restore, and report."""
    store, output = _places(params)
    if params.archive.restore:
        begun = time.perf_counter()
        restore(output, store, params.archive.threads)
        print(f"{store}: as archived in {output}, {time.perf_counter() - begun:.1f} s")
        return
    report = archive(store, output, params.archive.level, params.archive.threads)
    if report.seconds is None:
        print(f"{output}: there already, of this very store; nothing to do")
        return
    print("\n".join(report.lines()))
    ratio = report.raw_bytes / max(1, report.stored_bytes)
    rate = report.raw_bytes / 1e6 / report.seconds
    print(
        f"{output}: {report.raw_bytes / 1e6:.1f} MB in {report.stored_bytes / 1e6:.1f} MB "
        f"({ratio:.2f} : 1), {report.seconds:.1f} s ({rate:.0f} MB/s)"
    )


def _places(params: Params) -> tuple[Path, Path]:
    """The store and its archive."""
    store = params.archive.store or params.extract.store
    output = params.archive.output or store.with_name(f"{store.stem}.archive.zarr")
    if output.suffix != ".zarr":
        raise ConfigError(f"archive.output: expected a name that ends in .zarr, found {output}")
    if output.resolve().is_relative_to(store.resolve()):
        raise ConfigError(
            f"archive.output: {output} is the store {store} itself or lies in it. Name another "
            "place, or set it to null for one beside the store."
        )
    return store, output

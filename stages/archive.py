"""Make a small copy of a store to keep or to share, or restore the store from such a copy.

The archive is a plain zarr v3 group with the same arrays under the same names. It is compressed, in
a few large files, and every piece of them has a checksum. --restore gives back the store, equal in
every byte. If an archive is damaged, the damage is named and nothing damaged is restored.

  python -m stages.archive                       extract.store -> <its name>.archive.zarr beside it
  python -m stages.archive --restore             the store from that archive
  python -m stages.archive --set archive.level=15                     smaller, and much slower
  python -m stages.archive --restore --set archive.store=copy.zarr --set archive.output=a.zarr
                                                 copy.zarr from the archive a.zarr
"""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("archive",)
SHORTHANDS = (Shorthand("--restore", "archive.restore", "make the store from its archive"),)


def main(params: "Params") -> None:
    """Archive or restore, and report."""
    from pipeline.base.text import size
    from pipeline.store.archive import archive, restore
    from pipeline.store.inventory import bytes_on_disk

    store, output = _places(params)
    begun = time.perf_counter()
    if params.archive.restore:
        restore(output, store, params.archive.threads)
        print(f"{store}: as archived in {output}, {time.perf_counter() - begun:.1f} s")
        return
    raw = archive(store, output, params.archive.level, params.archive.threads)
    if raw is None:
        print(f"{output}: there already, of this very store; nothing to do")
        return
    seconds, stored = time.perf_counter() - begun, bytes_on_disk(output)
    print(
        f"{output}: {size(raw)} in {size(stored)} ({raw / stored:.2f} : 1), {seconds:.1f} s "
        f"({size(raw / seconds)}/s)"
    )


def _places(params: "Params") -> tuple[Path, Path]:
    """The store and its archive."""
    from pipeline.base.errors import ConfigError

    store = params.archive.store or params.extract.store
    output = params.archive.output or store.with_name(f"{store.stem}.archive.zarr")
    if output.suffix != ".zarr":
        raise ConfigError(
            f"archive.output: expected a name that ends in .zarr, found {output}. "
            f"Set archive.output={output.with_name(output.name + '.zarr')}"
        )
    return store, output


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))

"""Check a finished store: structure, files, the checksum of every row, NaN, clocks and offsets.

Reads every byte of verify.store (extract.store where null) and says what is wrong and where. Exit 0
where the store is sound; 2 with everything that is wrong and what to run next.

  python -m stages.verify                   check
  python -m stages.verify --reextract 100   also compute 100 random rows again and compare them
  python -m stages.verify --repair          begin a new build without what is damaged, which
                                            stages.extract then completes

The store itself is never written to.
"""

from stages.command import Shorthand, run

SHORTHANDS = (
    Shorthand("--reextract", "verify.reextract", "random rows to compute again", value="N"),
    Shorthand("--repair", "verify.repair", "begin a new build without what is damaged"),
)

if __name__ == "__main__":  # here, for --help waits for no import below
    raise SystemExit(
        run(__doc__ or "", "stages.verify", shorthands=SHORTHANDS, sections=("verify",))
    )

from pipeline.base.config import Params
from pipeline.base.errors import NumericsError, StoreIncomplete
from pipeline.extract.reextract import reextract
from pipeline.extract.repair import repair, with_identity
from pipeline.store.integrity import verify


def main(params: Params) -> None:
    """Check, and repair or compute rows again where asked to; raises where something is wrong."""
    store = params.verify.store or params.extract.store
    checked = verify(store, params.verify.threads, params.verify.workers)
    findings = with_identity(checked)
    print("\n".join([findings.summary(), *findings.notes]))
    if not findings.sound and params.verify.repair:
        print("\n".join(findings.lines()))
        print("\n".join(repair(findings, params, print).lines()))
        return
    if not findings.sound:
        said = [f"{store}: the store is damaged:", *findings.lines(), findings.advice()]
        raise StoreIncomplete("\n".join(said))
    print(f"{store}: sound")
    if params.verify.reextract:
        found = reextract(store, params, print)
        print("\n".join(found.lines()))
        if found.beyond:
            said = [f"{store}: rows are not what they would be today:", *found.refusals()]
            raise NumericsError("\n".join(said))

"""Does a store hold what it should, and what of it can be kept where it does not.

`verification` checks it whole: `structure` its metadata and files, `scan` the bytes of each chunk
file, `relations` what arrays must agree on. `findings` is what was found, `repair` begins a build
with all that is sound.
"""

from pipeline.store.integrity.findings import Damage, Findings
from pipeline.store.integrity.verification import verify

__all__ = ["Damage", "Findings", "verify"]

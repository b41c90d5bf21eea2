"""Does a store hold what it should, and what of it can be kept where it does not.

`verification` checks it whole. `repair` begins a build with all that is sound.
"""

from pipeline.store.integrity.verification import Verification, verify

__all__ = ["Verification", "verify"]

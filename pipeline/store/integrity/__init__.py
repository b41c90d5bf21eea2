"""Does a store hold what it should, and what of it can be kept where it does not.

`verification` checks it whole, `structure` its metadata and files. `repair` begins a build with all
that is sound.
"""

from pipeline.store.integrity.verification import Verification, judge_rows, verify

__all__ = ["Verification", "judge_rows", "verify"]

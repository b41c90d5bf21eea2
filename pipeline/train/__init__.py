"""Training a policy: one loop for every expert, from a store or with a live model in front.

Resumable at every checkpoint; on one process, or on several that torchrun started. This package
itself stays empty: most modules bring torch, and to see that a run is finished takes none.
"""

"""Training a policy: one loop for every expert, from a store or with a model in front that learns.

A run goes on from every checkpoint, on one process or on several of torchrun. This package imports
nothing: most modules import torch, which the check for a finished run does without.
"""

"""Training a policy: one loop for every expert, on features of a store or of a model that learns.

A run can resume from every checkpoint, on one process or on several that torchrun starts. This file
imports nothing: most modules import torch, and the check for a finished run must not.
"""

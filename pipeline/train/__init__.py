"""Training a policy: one loop for every expert, on features of a store or of a model that learns.

A run can resume from every checkpoint. This file imports nothing: most modules import torch, and
the check for a finished run must not.
"""

"""The policy: encoders, fusion, action experts, and its checkpoint.

This package imports nothing, so that a checkpoint's documents are read without torch.
"""

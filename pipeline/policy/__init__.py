"""What is trained: encoders, fusion, action experts, the policy made of them, its checkpoint.

This package itself stays empty, so that a checkpoint's documents are read without torch.
"""

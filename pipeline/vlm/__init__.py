"""Qwen2.5-VL, frozen or learning: the only place that imports transformers or peft.

`feature_spec` defines a feature without loading a weight. `preparation` turns an instruction and
frames into tokens and pixels on the CPU, as the checkpoint's `processor` does. `qwen` encodes
prepared rows, with the batches of `collation` and the tower of `vision`; `live` does so with
gradients, and saves the weights that it learned.
Import from those modules: this package itself stays empty, so that to compare two feature specs
needs no import of transformers.
"""

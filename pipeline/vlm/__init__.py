"""Qwen2.5-VL, frozen or learning: the only place that imports transformers or peft.

`feature_spec` says what a feature is without loading a weight; `preparation` turns an instruction
and frames into tokens and pixels on the CPU, as the checkpoint's `processor` does; `qwen` encodes
prepared rows, `live` does so with gradients and saves what `tuning` let it learn. Both compute by
`extractor`, from what `collation` sends to the device, with the tower of `vision`. Import from
those modules: this package itself stays empty, so that comparing two feature specs costs no import
of transformers.
"""

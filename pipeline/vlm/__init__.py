"""The frozen Qwen2.5-VL: the only place that imports transformers or peft.

`feature_spec` says what a feature is without loading a weight, `preparation` turns an instruction
and frames into tokens and pixels on the CPU, `qwen` encodes prepared rows. Import from those
modules: this package itself stays empty, so that comparing two feature specs costs no import of
transformers.
"""

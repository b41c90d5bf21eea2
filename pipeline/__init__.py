"""Two stages around one store.

    recordings -> timeline -> extraction (vlm) -> store -> sampling -> policy -> evaluation

`base`        what every room stands on: errors, config, durable files, digests, how amounts read
`data`        files on disk -> Recording -> ticks: one reader a format, and the timeline
`vlm`         what a feature is, and the Qwen2.5-VL that computes it, frozen or learning
`store`       the seam: a zarr store that is also a set of flat files; verify, archive, admin
`policy`      encoders, fusion, action experts, the policy, its checkpoint
`extract`     stage one: recordings x vlm -> store, here or on dask workers
`train`       stage two: split, batches, one loop; fine-tuning is that loop with the model in front
`simulation`  a simulated needle insertion, and the demo recordings
`evaluate`    scores beside baselines, ablation, comparison, probe
`compat`      the names of the research code; `models` and `datasets` are its doors
`look`        one room a topic: a recording, a store, an evaluation, a machine; and their pages

Imports go only upwards in this list, and never within {data, vlm, store, policy}, {extract, train,
simulation} or {models, datasets, look}; `tests/test_architecture.py` keeps that true.
"""

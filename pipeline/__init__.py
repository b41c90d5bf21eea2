"""Two stages around one store.

    recordings -> timeline -> extraction (vlm) -> store -> sampling -> models -> evaluation

`errors`       what can go wrong, named
`config`       params.yaml -> Params
`amounts`      bytes and seconds, as people read them
`channels`     channels by name: which are alike, and which hardly move
`digests`      content digests of files, remembered
`durable`      files that survive a kill
`ownership`    which folders may be replaced
`device`       which device does the tensor maths
`scheduler`    dask processes that nobody else reaches, or the user's own scheduler
`recordings`   files on disk -> Recording
`vlm`          the frozen Qwen2.5-VL, and what a feature is
`store`        the seam: a zarr store that is also a set of flat files
`normalization` statistics of training ticks
`models`       encoders, fusion, action experts, policy
`timeline`     clocks -> ticks
`simulation`   a simulated needle insertion, and the demo recordings
`sampling`     split by episode, mixture weights, resumable order
`checkpoint`   a trained policy on disk
`batches`      gathered ahead, from the map, the device or an archive
`extraction`   recordings x vlm -> store, here or on dask workers
`evaluation`   predictions -> figures of merit
`datasets`     recordings and store as torch data sets, under the names of the old code
`machine`      what this computer can do, and what to install
`training`     one loop for every expert
`probing`      which slots carry the action, by ridge regression
`inspection`   what a recording or a store holds, and what looks wrong
`finetuning`   the same loop with the model in front of the policy learning too
`plots`        arrays -> pictures
`report`       pictures, tables and words -> one self-contained page

Imports go only upwards in this list, and never within {recordings, vlm, store, normalization,
models}, but for `models.unified`, the policy with a live model in front;
`tests/test_architecture.py` keeps that true.
"""

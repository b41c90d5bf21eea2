"""Which stored features predict the action: slots ranked by a linear regression from each.

`folds` holds recordings out, `inputs` prepares what is read at a tick, `ridge` is the regression,
`study` scores all slots and says which are better, and `tables` prints and writes the results.
"""

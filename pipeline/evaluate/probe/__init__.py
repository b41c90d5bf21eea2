"""Which stored features predict the action: slots ranked by a linear regression from each.

`inputs` prepares what is read at a tick, `ridge` is the regression and its folds of recordings,
`study` scores all slots and says which are better, and `tables` prints and writes the results.
"""

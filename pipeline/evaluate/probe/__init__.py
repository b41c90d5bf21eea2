"""Which stored feature carries the action: slots ranked by what a linear reader finds in them.

`folds` holds recordings out, `inputs` is what is read at a tick, `ridge` the regression, `study`
does it for all slots and says which are better, and `tables` tells it.
"""

"""Stage one: recordings x frozen model -> store.

`survey` says which episodes there are, `check` reads them whole, `layout` writes all that needs no
model, `rows` decodes, `encoder` encodes, `commits` writes behind it, all of which `fill` brings
together, `run` is the list of these steps.
"""

from pipeline.extract.run import ExtractionReport, extract

__all__ = ["ExtractionReport", "extract"]

"""Stage one: recordings x frozen model -> store.

`survey` says which episodes there are, `check` reads them whole, `layout` writes all that needs no
model, `rows` decodes, encodes and commits, `run` is the list of these steps.
"""

from pipeline.extraction.run import ExtractionReport, extract

__all__ = ["ExtractionReport", "extract"]

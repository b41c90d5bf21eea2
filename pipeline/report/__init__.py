"""Pictures, tables and words -> one page that needs nothing beside itself.

`page` says what one is made of and writes it; `evaluation` and `inspection` build those of this
project, each apart from these: they know other rooms.
"""

from pipeline.report.page.blocks import (
    Block,
    Chart,
    Document,
    Notice,
    Notices,
    Picture,
    Place,
    Report,
    Run,
    Section,
    Table,
    Text,
    Tokens,
)
from pipeline.report.page.writing import PAGE, write_report

__all__ = [
    "PAGE",
    "Block",
    "Chart",
    "Document",
    "Notice",
    "Notices",
    "Picture",
    "Place",
    "Report",
    "Run",
    "Section",
    "Table",
    "Text",
    "Tokens",
    "write_report",
]

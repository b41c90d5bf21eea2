"""Pictures, tables and words -> one page that needs nothing beside itself.

`blocks` says what a page is made of, `page` writes it; `recording`, `store` and `evaluation` build
the pages of this project, each apart from these: they know other rooms.
"""

from pipeline.report.blocks import (
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
from pipeline.report.page import PAGE, write_report

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

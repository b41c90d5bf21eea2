"""The blocks of a page, and how `writing` makes HTML and PNG files of them by `templates/`."""

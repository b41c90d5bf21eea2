"""What lies in a folder of stores, and what of it nothing needs any more.

`inventory` takes stock, `contents` says what an entry holds, `listing` shows it to people,
`leftovers` finds and removes what is of no use.
"""

from pipeline.store.housekeeping.inventory import Inventory, take_inventory
from pipeline.store.housekeeping.leftovers import Leftover, kept_back, leftovers, named, remove
from pipeline.store.housekeeping.listing import table

__all__ = [
    "Inventory",
    "Leftover",
    "kept_back",
    "leftovers",
    "named",
    "remove",
    "table",
    "take_inventory",
]

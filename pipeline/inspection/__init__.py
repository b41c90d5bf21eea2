"""What a recording or a store holds, and what looks wrong in it.

`subject` says what a path means. Of recordings: `episodes` reads one as far as it can be read,
`overview` goes over all of them; `clocks`, `statistics`, `contact`, `frames`, `samples` and
`prompt` each look at one episode, and `flaws` gathers what `clock_flaws`, `count_flaws`,
`channel_flaws` and `pixel_flaws` find in it. What they find is plain data, of `facts`. The modules
`store…` do the same for a store.

Import from those modules: this package itself stays empty, so that looking at a store does not
import what reads recordings.
"""

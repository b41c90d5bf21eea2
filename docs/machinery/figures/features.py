"""Figures of a feature: which slots a row has, and what makes a row a different one."""

from drawing import Drawing

TOKENS = (("text", 2), ("View1", 4), ("View2", 4), ("text", 3))
POOLINGS = (
    ("mean", "every token", ((0, 13),)),
    ("image_mean", "image tokens", ((2, 10),)),
    ("text_mean", "the others", ((0, 2), (10, 13))),
    ("view_mean", "one slot a view", ((2, 6), (6, 10))),
    ("last", "the last token", ((12, 13),)),
)
TOKEN = 21.0
ROW = (
    "mean",
    "View1 cell 0",
    "View1 cell 1",
    "…",
    "View1 cell 15",
    "View2 cell 0",
    "…",
    "View2 cell 15",
)
"""The slots that mean and grid of two views give, from one layer with the norm."""


def slots() -> Drawing:
    """Layers on the left; the poolings over one row of tokens; the slots that come of them."""
    drawing = Drawing(
        820,
        426,
        "A slot is one layer, with or without the final norm, pooled over some of the tokens: "
        "all of them, those of images, of text, of each view, of 4 x 4 cells a view, or the last.",
    )
    for x, name, said in (
        (10, "vlm.layers", "whose output"),
        (138, "vlm.norms", "final norm"),
        (248, "vlm.pooling", "mean over which tokens"),
    ):
        drawing.text(x, 24, name, mono=True, bold=True)
        drawing.text(x, 44, said, "mute")
    drawing.text(670, 24, "one VL row", bold=True)
    drawing.text(670, 44, "(slot, dim)", "mute", mono=True)
    _layers(drawing)
    _poolings(drawing, 248, 88)
    _grid(drawing, 248, 348)
    for index, name in enumerate(ROW):
        y = 68 + 34 * index
        drawing.box(670, y, 140, 26, "vl", fill=0.12 if index else 0.3)
        drawing.text(740, y + 18, name, anchor="middle")
    drawing.arrow((638, 204), (666, 204), colour="vl", width=2)
    said = ["mean and grid", "of two views:", "1 + 16 + 16 slots"]
    drawing.text(670, 364, said, "mute")
    return drawing


def _layers(drawing: Drawing) -> None:
    taken = {2: "8", 5: "17", 8: "-1"}
    for index in range(9):
        y = 340 - 30 * index
        mine = index in taken
        fill, line = (0.35, 2) if mine else (0.06, 1)
        drawing.box(42, y, 72, 22, "vl" if mine else "mute", fill=fill, line=line)
        if mine:
            drawing.text(34, y + 16, taken[index], "vl", anchor="end", bold=True)
            drawing.arrow((116, y + 11), (138, y + 11), colour="vl", width=2)
    drawing.arrow((78, 390), (78, 366))
    drawing.text(78, 408, "tokens", "mute", anchor="middle")
    drawing.box(140, 64, 74, 338, fill=0.04, dash="4 4")
    drawing.text(177, 200, ["true", "and / or", "false"], anchor="middle")
    drawing.arrow((216, 220), (240, 220), colour="vl", width=2)


def _poolings(drawing: Drawing, x: float, y: float) -> None:
    """A row of tokens, and under it what each pooling averages."""
    place = x
    for name, count in TOKENS:
        colour = "mute" if name == "text" else "frame"
        for _ in range(count):
            drawing.box(place, y - 24, TOKEN - 3, 20, colour, fill=0.3, line=1, radius=2)
            place += TOKEN
        drawing.text(place - TOKEN * count / 2 - 1, y + 13, name, colour, anchor="middle")
    label = place + 10
    for row, (name, meaning, spans) in enumerate(POOLINGS):
        top = y + 28 + 40 * row
        for begin, end in spans:
            left, width = x + TOKEN * begin, TOKEN * (end - begin) - 3
            drawing.box(left, top, width, 18, "vl", fill=0.4, radius=8)
        drawing.text(label, top + 8, name, mono=True, bold=True)
        drawing.text(label, top + 25, meaning, "mute")


def _grid(drawing: Drawing, x: float, y: float) -> None:
    side = 15.0
    for view in range(2):
        left = x + TOKEN * (2 + 4 * view) + 12
        for cell in range(16):
            colour, fill = ("action", 0.8) if cell == 6 else ("vl", 0.25)
            place = (left + side * (cell % 4), y - 28 + side * (cell // 4))
            drawing.box(*place, side - 2, side - 2, colour, fill=fill, line=1, radius=2)
    label = x + TOKEN * 13 + 10
    drawing.text(label, y - 3, "grid", mono=True, bold=True)
    drawing.text(label, y + 14, "4 x 4 a view", "mute")
    drawing.text(x - 14, y - 2, ["keeps", "place"], "mute")


SPEC = (
    "weights of the checkpoint",
    "weights of the adapter",
    "processor: image size, patches",
    "prompt template, chat template",
    "order of views",
    "layers, norms, poolings, variants",
    "compute dtype, storage dtype",
    "EXTRACTOR_VERSION of the code",
)
OUTSIDE = (
    "attention backend",
    "library versions",
    "batch size, workers, device",
    "every key of train_head",
)


def identity() -> Drawing:
    """What is digested into the spec and into a row's key, and what is not."""
    drawing = Drawing(
        820,
        384,
        "The feature spec is a digest of the weights, the processor, the prompt, the slots and the "
        "dtypes; a row's key is one of the spec, the prompt and the pixels of its frames.",
    )
    drawing.text(10, 26, "What decides what a feature is", bold=True)
    for index, said in enumerate(SPEC):
        y = 42 + 33 * index
        drawing.box(10, y, 256, 27, "vl", fill=0.12)
        drawing.text(20, y + 19, said)
        drawing.arrow((268, y + 13.5), (296, 160 if index < 4 else 172), colour="vl", width=1)
    drawing.box(298, 132, 112, 68, "vl", fill=0.35, line=2)
    drawing.text(354, 162, "feature spec", anchor="middle", bold=True)
    drawing.text(354, 184, "digest", "mute", anchor="middle")
    drawing.arrow((412, 166), (524, 166), colour="vl", width=2)
    for y, colour, said in ((54, "ink", "rendered prompt"), (244, "frame", "decoded RGB pixels")):
        drawing.box(388, y, 160, 34, colour, fill=0.12)
        drawing.text(468, y + 22, said, anchor="middle")
    drawing.text(468, 298, "of each frame, in view order", "mute", anchor="middle")
    drawing.arrow((550, 74), (591, 130))
    drawing.arrow((550, 258), (591, 202), colour="frame")
    drawing.box(526, 132, 130, 68, "action", fill=0.2, line=2)
    drawing.text(591, 162, "key of a row", anchor="middle", bold=True)
    drawing.text(591, 184, "vl/key, 16 bytes", "mute", anchor="middle")
    drawing.arrow((658, 166), (684, 166))
    for y, colour, said in (
        (124, "state", ["known key:", "taken over"]),
        (176, "action", ["unknown key:", "computed"]),
        (228, "action", ["another spec:", "nothing is", "taken over"]),
    ):
        drawing.text(690, y, said, colour, bold=True)
    drawing.text(10, 334, "No part of it", bold=True)
    for x, width, said in zip((10, 162, 300, 512), (140, 126, 200, 180), OUTSIDE, strict=True):
        drawing.box(x, 346, width, 28, "mute", fill=0.05, dash="4 4")
        drawing.text(x + width / 2, 365, said, "mute", anchor="middle")
    return drawing

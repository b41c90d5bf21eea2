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
TOKEN = 26.0


def slots() -> Drawing:
    """Layers on the left; the poolings over one row of tokens; the slots that come of them."""
    drawing = Drawing(
        980,
        430,
        "A slot is one layer, with or without the final norm, pooled over some of the tokens: "
        "all of them, those of images, of text, of each view, of 4 x 4 cells a view, or the last.",
    )
    _layers(drawing)
    _tokens(drawing, 330, 96)
    _grid(drawing, 330, 356)
    _result(drawing, 790)
    return drawing


def _layers(drawing: Drawing) -> None:
    drawing.text(20, 30, "vlm.layers", mono=True, bold=True)
    drawing.text(20, 50, "whose output", "mute", size=13)
    taken = {2: "8", 5: "17", 8: "-1"}
    for index in range(9):
        y = 352 - 30 * index
        mine = index in taken
        drawing.box(
            60,
            y,
            96,
            22,
            "vl" if mine else "mute",
            fill=0.35 if mine else 0.06,
            line=2 if mine else 1,
        )
        if mine:
            drawing.text(48, y + 16, taken[index], "vl", anchor="end", bold=True)
            drawing.arrow((158, y + 11), (206, y + 11), colour="vl", width=2)
    drawing.text(108, 398, "tokens", "mute", size=13, anchor="middle")
    drawing.arrow((108, 384), (108, 376))
    drawing.box(208, 74, 62, 322, "ink", fill=0.04, dash="4 4")
    drawing.text(239, 30, "vlm.norms", mono=True, bold=True, anchor="middle")
    drawing.text(239, 50, "final norm", "mute", size=13, anchor="middle")
    drawing.text(239, 212, ["true", "and / or", "false"], anchor="middle", size=13)
    drawing.arrow((272, 232), (316, 232), colour="vl", width=2)


def _tokens(drawing: Drawing, x: float, y: float) -> None:
    drawing.text(x, 30, "vlm.pooling", mono=True, bold=True)
    drawing.text(x, 50, "mean over which tokens", "mute", size=13)
    place = x
    for name, count in TOKENS:
        colour = "mute" if name == "text" else "frame"
        for index in range(count):
            drawing.box(
                place + TOKEN * index, y - 26, TOKEN - 3, 20, colour, fill=0.3, line=1, radius=2
            )
        drawing.text(place + TOKEN * count / 2 - 1, y + 10, name, colour, size=12, anchor="middle")
        place += TOKEN * count
    for row, (name, meaning, spans) in enumerate(POOLINGS):
        top = y + 26 + 38 * row
        for begin, end in spans:
            drawing.box(
                x + TOKEN * begin,
                top,
                TOKEN * (end - begin) - 3,
                16,
                "vl",
                fill=0.4,
                line=1.5,
                radius=8,
            )
        label = x + TOKEN * 13 + 10
        drawing.text(label, top + 7, name, mono=True, size=12, bold=True)
        drawing.text(label, top + 22, meaning, "mute", size=12)


def _grid(drawing: Drawing, x: float, y: float) -> None:
    side = 15.0
    for view in range(2):
        left = x + TOKEN * (2 + 4 * view) + 18
        for cell in range(16):
            drawing.box(
                left + side * (cell % 4),
                y - 28 + side * (cell // 4),
                side - 2,
                side - 2,
                "vl" if cell != 6 else "action",
                fill=0.25 if cell != 6 else 0.8,
                line=1,
                radius=2,
            )
    label = x + TOKEN * 13 + 10
    drawing.text(label, y - 3, "grid", mono=True, size=12, bold=True)
    drawing.text(label, y + 12, "4 x 4 cells a view", "mute", size=12)
    drawing.text(x, y - 2, ["keeps", "the place"], "mute", size=12)


def _result(drawing: Drawing, x: float) -> None:
    """The slots that mean and grid of two views give, from one layer with the norm."""
    drawing.text(x + 38, 30, "one VL row", bold=True)
    drawing.text(x + 38, 50, "(slot, dim)", "mute", mono=True, size=13)
    names = (
        "mean",
        "View1 cell 0",
        "View1 cell 1",
        "…",
        "View1 cell 15",
        "View2 cell 0",
        "…",
        "View2 cell 15",
    )
    for index, name in enumerate(names):
        y = 74 + 34 * index
        drawing.box(x + 38, y, 140, 26, "vl", fill=0.3 if index == 0 else 0.12)
        drawing.text(x + 108, y + 18, name, anchor="middle", size=13)
    drawing.arrow((x - 2, 210), (x + 34, 210), colour="vl", width=2)
    drawing.text(x + 38, 368, "one layer, norm true,", "mute", size=12)
    drawing.text(x + 38, 384, "mean and grid, 2 views:", "mute", size=12)
    drawing.text(x + 38, 400, "1 + 16 + 16 = 33 slots", "mute", size=12)


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
        980,
        384,
        "The feature spec is a digest of the weights, the processor, the prompt, the slots and the "
        "dtypes; a row's key is one of the spec, the prompt and the pixels of its frames.",
    )
    drawing.text(20, 30, "What decides what a feature is", bold=True)
    for index, said in enumerate(SPEC):
        y = 46 + 33 * index
        drawing.box(20, y, 262, 27, "vl", fill=0.12)
        drawing.text(34, y + 19, said, size=13)
        drawing.arrow((284, y + 13.5), (330, 164 if index < 4 else 176), colour="vl", width=1)
    drawing.box(332, 136, 148, 68, "vl", fill=0.35, line=2)
    drawing.text(406, 166, "feature spec", anchor="middle", bold=True)
    drawing.text(406, 187, "digest", "mute", anchor="middle", size=13)
    drawing.arrow((482, 170), (614, 170), colour="vl", width=2)
    for y, colour, said in ((60, "ink", "rendered prompt"), (250, "frame", "decoded RGB pixels")):
        drawing.box(462, y, 178, 34, colour, fill=0.12)
        drawing.text(551, y + 22, said, anchor="middle", size=13)
    drawing.text(551, 302, "of each frame, in view order", "mute", anchor="middle", size=12)
    drawing.arrow((642, 82), (694, 136))
    drawing.arrow((642, 264), (694, 206), colour="frame")
    drawing.box(616, 138, 158, 66, "action", fill=0.2, line=2)
    drawing.text(695, 166, "key of a row", anchor="middle", bold=True)
    drawing.text(695, 187, "vl/key, 16 bytes", "mute", anchor="middle", mono=True, size=12)
    drawing.arrow((776, 171), (812, 171))
    drawing.text(818, 132, ["known key:", "taken over"], "state", size=13, bold=True)
    drawing.text(818, 180, ["unknown key:", "computed"], "action", size=13, bold=True)
    drawing.text(
        818, 228, ["another spec:", "nothing is", "taken over"], "action", size=13, bold=True
    )
    drawing.text(20, 334, "No part of it", bold=True)
    x = 20.0
    for said in OUTSIDE:
        width = 26 + 7.6 * len(said)
        drawing.box(x, 346, width, 27, "mute", fill=0.05, dash="4 4")
        drawing.text(x + width / 2, 364, said, "mute", size=13, anchor="middle")
        x += width + 14
    return drawing

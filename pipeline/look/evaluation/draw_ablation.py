"""The picture that says which streams a policy uses."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluate.ablation import Ablated, AblationStudy
from pipeline.evaluate.tables import ABLATION_FOOTNOTE, best_baseline
from pipeline.look.page.style import GRID, INK, LABELS, STYLES, canvas, legend_below

COLOURS = {
    "zeroed": "#0072B2",
    "missing": "#56B4E9",
    "shuffled": "#D55E00",
    "delayed": "#999999",
}


def modalities(study: AblationStudy) -> Figure:
    """The error with each stream ablated as a multiple of the intact one, a panel a stream.

    The error itself, in units of the training standard deviation, where the intact one is 0.
    """
    unit = study.intact.overall("policy") or 1.0
    panels = [[one for one in study.ablated if one.stream == name] for name in study.streams]
    widths = [len(panel) for panel in panels]
    figure = canvas(max(0.95 * sum(widths) + 1.5, 7.5), 4.6)
    axes = figure.subplots(
        1, len(panels), squeeze=False, sharey=True, gridspec_kw={"width_ratios": widths}
    )[0]
    for axis, panel in zip(axes, panels, strict=True):
        _panel(axis, panel, study, unit)
    axes[0].set_ylabel("held-out error / error with all streams intact")
    axes[0].set_ylim(0, 1.12 * axes[0].get_ylim()[1])
    legend_below(figure, axes[0], 2)
    figure.legends[0].set_title(ABLATION_FOOTNOTE)
    figure.suptitle(
        f"What the policy loses with one stream ablated, on {study.intact.ticks} held-out ticks, "
        f"{study.samples} chunk(s) a tick\n"
        "(well above 1: the stream is used; delays fade where a stream changes slowly)"
    )
    return figure


def _panel(axis: Axes, panel: list[Ablated], study: AblationStudy, unit: float) -> None:
    heights = [one.comparison.overall("policy") / unit for one in panel]
    colours = [COLOURS[one.how.split()[0]] for one in panel]
    bars = axis.bar(range(len(panel)), heights, color=colours, width=0.7)
    # On a ground of its own, for a line may pass behind a number.
    axis.bar_label(
        bars, fmt="%.2f", padding=3, bbox={"facecolor": GRID, "edgecolor": "none", "pad": 1}
    )
    best = best_baseline(study.intact)
    axis.axhline(
        study.intact.overall("policy") / unit,
        color=STYLES["policy"]["color"],
        lw=1.8,
        label="policy, all streams intact",
    )
    axis.axhline(
        study.intact.overall(best) / unit,
        color=INK,
        lw=1.8,
        ls="--",
        label=f"best {LABELS[best]}, which sees nothing",
    )
    axis.set_xticks(range(len(panel)), [one.how.replace(" ", "\n", 1) for one in panel])
    axis.grid(axis="x", visible=False)
    axis.set_title(panel[0].stream)

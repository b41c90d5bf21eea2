"""The picture of several experiments side by side."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from pipeline.evaluate.experiments import Experiment
from pipeline.look.page.style import LABELS, STYLES, canvas
from pipeline.train.predictions import BASELINES

COLOURS = ("#0072B2", "#D55E00", "#56B4E9", "#F0E442", "#999999")
"""Of the experts, in the order in which they come."""


def comparison_of_experiments(experiments: Sequence[Experiment]) -> Figure:
    """Held-out error of each experiment, coloured by expert, and the baselines as lines."""
    figure = canvas(9.0, 0.36 * len(experiments) + 2.6)
    axis = figure.subplots()
    experts = list(dict.fromkeys(one.model_type for one in experiments))
    for index, expert in enumerate(experts):
        places = [i for i, one in enumerate(experiments) if one.model_type == expert]
        errors = [experiments[i].error for i in places]
        colour = COLOURS[index % len(COLOURS)]
        axis.barh(places, errors, color=colour, height=0.72, label=expert.replace("_", " "))
    for method in BASELINES:
        style = STYLES[method]
        axis.axvline(
            experiments[0].overall[method],
            color=style["color"],
            ls=style["linestyle"],
            lw=2,
            label=LABELS[method],
        )
    for place, one in enumerate(experiments):
        # Beside the panel: at its bar's end a number would lie on the baselines that are near.
        axis.annotate(
            f"{one.error:.3f}",
            (1, place),
            xycoords=axis.get_yaxis_transform(),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
        )
    axis.set_yticks(np.arange(len(experiments)), [one.name for one in experiments])
    axis.invert_yaxis()
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("mean absolute error on held-out ticks [training std] (left is better)")
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle("Held-out error by expert and fusion, trained from one store")
    return figure

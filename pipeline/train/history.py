"""The loss and its parts at every step, fetched from the device a few steps at a time."""

from collections.abc import Mapping, Sequence
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor


class History:
    """One row a step of named scalars.

    Rows stay on the device until `settle`: reading a scalar at every step would make the CPU wait
    for the GPU at every step.
    """

    def __init__(self) -> None:
        self.columns: tuple[str, ...] = ()
        self._settled = torch.empty((0, 0), dtype=torch.float64)
        self._pending: list[Mapping[str, Tensor]] = []

    @classmethod
    def of(cls, columns: Sequence[str], rows: Float[Tensor, "step column"]) -> Self:
        """The history of an earlier start."""
        history = cls()
        history.columns, history._settled = tuple(columns), rows
        return history

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Add the scalars of the next step; every step has the same names."""
        self.columns = self.columns or tuple(values)
        self._pending.append(values)

    def settle(self) -> int | None:
        """Fetch what is pending; the index of the first step with a NaN or inf, if there is one."""
        if not self._pending:
            return None
        first = len(self._settled)
        scalars = [values[name].float() for values in self._pending for name in self.columns]
        rows = torch.stack(scalars).view(-1, len(self.columns)).to("cpu", torch.float64)
        self._pending.clear()
        self._settled = torch.cat([self._settled.view(-1, len(self.columns)), rows])
        bad = ~torch.isfinite(rows).all(dim=1)
        return first + int(bad.nonzero()[0, 0]) if bad.any() else None

    def tensor(self) -> Float[Tensor, "step column"]:
        """All settled rows, float64."""
        return self._settled

    def mean(self, first: int, stop: int) -> dict[str, float]:
        """The mean of each column over the settled steps [first, stop)."""
        means = self._settled[first:stop].mean(dim=0).tolist()
        return dict(zip(self.columns, means, strict=True))

    def last(self, name: str) -> float:
        """A column at the newest settled step."""
        return float(self._settled[-1, self.columns.index(name)])

    def describe(self, step: int) -> str:
        """A step's row as text."""
        row = zip(self.columns, self._settled[step].tolist(), strict=True)
        return ", ".join(f"{name} {value:g}" for name, value in row)

"""A running mean of scores, over scenarios and over processes."""

from __future__ import annotations

import sys
from typing import Any, Dict, Iterable, List

from .. import wosac


class Running:
    """Sums of scores. Where `torch.distributed` runs, means are over all of its processes."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names: List[str] = list(names)
        self.reset()

    def reset(self) -> None:
        """Forgets all scenarios."""
        self.count = 0
        self.sums = dict.fromkeys(self.names, 0.0)

    def add(self, scores: wosac.Scores) -> None:
        """Adds a scenario."""
        self.count += 1
        for name in self.names:
            self.sums[name] += getattr(scores, name)

    def means(self) -> Dict[str, float]:
        """The means; `ValueError` without any scenario."""
        totals = _over_processes([float(self.count), *self.sums.values()])
        if totals[0] == 0.0:
            raise ValueError("expected at least one scenario before compute(), found none")
        return {name: total / totals[0] for name, total in zip(self.names, totals[1:])}

    def total(self) -> float:
        """Scenarios in all processes."""
        return _over_processes([float(self.count)])[0]


def _over_processes(numbers: List[float]) -> List[float]:
    torch = sys.modules.get("torch")
    if torch is None or not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return numbers
    device = "cuda" if torch.distributed.get_backend() == "nccl" else "cpu"
    sums = torch.tensor(numbers, dtype=torch.float64, device=device)
    torch.distributed.all_reduce(sums)
    return sums.tolist()


def tensor(number: float) -> Any:
    """A tensor of PyTorch where that is loaded, else the number."""
    torch = sys.modules.get("torch")
    return number if torch is None else torch.tensor(number)

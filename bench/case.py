"""Figures of one case, each with its target, and the program that prints them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Case:
    """Figures of one case, each with its target; a peer's figure has none."""

    name: str
    rows: list[tuple[str, float, str]] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def figure(self, label: str, value: float, low: float = -np.inf, high: float = np.inf) -> None:
        target = (
            "" if low == -np.inf and high == np.inf else f"{low:g} .. {high:g}" if low > -np.inf else f"<= {high:g}"
        )
        self.rows.append((label, float(value), target))
        if not low <= value <= high:
            self.missed.append(f"{self.name}: {label} is {value:.4g}, target {target}")


def run(doc: str | None, cases: Mapping[str, Callable[[Case], None]]) -> int:
    """All cases or --only one, as words or --json; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--only", choices=list(cases))
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    done = []
    for name in [args.only] if args.only else list(cases):
        case = Case(name)
        cases[name](case)
        done.append(case)
        if not args.json:
            print(f"\n{name}")
            for label, value, target in case.rows:
                print(f"  {label:68s} {value:10.4g}   {target}", flush=True)
    missed = [m for case in done for m in case.missed]
    if args.json:
        print(json.dumps({c.name: {label: value for label, value, _ in c.rows} for c in done} | {"missed": missed}))
    for m in missed:
        print(f"MISSED {m}", file=sys.stderr)
    return 1 if missed else 0

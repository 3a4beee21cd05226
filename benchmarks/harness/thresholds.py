"""Thresholds of all benchmarks, with one printed line per figure: "figure: measured, threshold".

A figure that was not measured at its intended size has no line.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import click


@dataclasses.dataclass(frozen=True)
class Threshold:
    """A figure in words, its bound, an optional aim, and ``most``: True if the bound is an upper bound."""

    figure: str
    bound: float
    aim: float | None = None
    unit: str = "×"
    most: bool = False

    def met(self, measured: float) -> bool:
        """True if the bound holds; False for NaN."""
        return measured <= self.bound if self.most else measured >= self.bound

    def line(self, measured: float) -> str:
        """The figure, the measurement and the threshold."""
        sign = "≤" if self.most else "≥"
        aim = "" if self.aim is None else f", aim {self.aim:g}{self.unit}"
        return (
            f"{self.figure}: {measured:.3g}{self.unit}, threshold {sign} {self.bound:g}{self.unit}{aim}: "
            f"{'met' if self.met(measured) else 'MISSED'}"
        )


CHAIN = "pendulum 200 x 201, 21 controls, to 1e-3, against the faster of QuantEcon's two methods"
FIRST = "first answer of the pendulum at its default on {} over one compilation of its loop"
DEFAULT = "its default with the error of the grid over the monotone answer alone"
COLD = f"pendulum {{}}, first answers, {DEFAULT}"
HAND = "pendulum {} to 1e-3, 21 controls, against the numba solver"
DEVICES = "pendulum {} to 1e-3, seconds on two devices of one processor over those on one"
THRESHOLDS = {
    "sweep 1024": Threshold("sweep on 1024 x 1024, 21 controls, float32, against the numba loop", 1.5, 2.5),
    "sweep 2048": Threshold("sweep on 2048 x 2048, 21 controls, float32, against the numba loop", 1.5, 2.5),
    "step 1024": Threshold("whole step on 1024 x 1024, 21 controls, float32, against the numba loop", 4.5),
    "sweep 6-D": Threshold("one value-iteration sweep on 20^6, beside two values", 16, unit=" bytes a node", most=True),
    "quantecon": Threshold(f"{CHAIN}, compiled", 20, 50),
    "quantecon cold": Threshold(f"{CHAIN}, our compile time counted", 2, 3.5),
    "numba 200 nested": Threshold(HAND.format("200 x 201, both by nested grids,"), 1.2, 1.5),
    "numba 200": Threshold(HAND.format("200 x 201"), 1.5),
    "numba 400": Threshold(HAND.format("400 x 401"), 3.5),
    "numba 800": Threshold(HAND.format("800 x 801"), 6.5),
    "numba 1600": Threshold(HAND.format("1600 x 1601"), 5),
    "growth": Threshold("pendulum, seconds at 1600 x 1601 over those at 400 x 401", 24, most=True),
    "growth undiscounted": Threshold(
        "pendulum without discount, by default, seconds at 1600 x 1601 over those at 400 x 401", 22, most=True
    ),
    "dubins bytes": Threshold("Dubins car 101 x 101 x 100, peak", 100, unit=" bytes a node", most=True),
    "dubins exponent": Threshold("Dubins car, exponent of seconds in nodes", 1.2, unit="", most=True),
    "manipulator bytes": Threshold("two-link arm 40 x 40 x 41 x 41, peak", 100, unit=" bytes a node", most=True),
    "manipulator exponent": Threshold("two-link arm, exponent of seconds in nodes", 1.2, unit="", most=True),
    "import": Threshold("import hjbjax over import jax", 1.3, most=True),
    "first pendulum 101": Threshold(FIRST.format("100 x 101"), 2.2, 1.4, most=True),
    "first pendulum 401": Threshold(FIRST.format("400 x 401"), 3, 1.8, most=True),
    "first pendulum 801": Threshold(FIRST.format("800 x 801"), 4.2, 2.2, most=True),
    "cold default 201": Threshold(COLD.format("200 x 201"), 1.3, most=True),
    "cold default 401": Threshold(COLD.format("400 x 401"), 1.3, most=True),
    "warm default 101": Threshold(f"pendulum 100 x 101, warm, {DEFAULT}", 2, most=True),
    "warm default 201": Threshold(f"pendulum 200 x 201, warm, {DEFAULT}", 1.8, most=True),
    "warm default 401": Threshold(f"pendulum 400 x 401, warm, {DEFAULT}", 1.8, most=True),
    "programs": Threshold("pendulum by default, the most programs compiled", 14, unit="", most=True),
    "quantecon cold 160": Threshold("pendulum 160 x 161, 31 controls, our first answer against QuantEcon's", 1.8, 2.5),
    "quantecon cold 200": Threshold("pendulum 200 x 201, 21 controls, our first answer against QuantEcon's", 3, 4),
    "one grid": Threshold("first answers of the zoo, one grid over the default, the least", 1 / 1.2),
    "cold start": Threshold("process start to pictures, no cache", 12, unit=" s", most=True),
    "cached start": Threshold("process start to pictures, with the compile cache", 7, unit=" s", most=True),
    "gradient": Threshold("value and gradient of a solve over its value, the most of seven", 3, 2, most=True),
    "devices 800": Threshold(DEVICES.format("800 x 801"), 0.85, 0.7, most=True),
    "devices 1600": Threshold(DEVICES.format("1600 x 1601"), 1, 0.7, most=True),
    "devices steps": Threshold("pendulum 800 x 801, outer steps on eight devices over those on one", 1.2, most=True),
    "batch": Threshold("solve_batch of 64 pendulums at 100 x 101, against one by one", 1.7, 10),
}


def announced(measured: Mapping[str, float], benchmark: str) -> list[dict[str, Any]]:
    """Print one line per measured figure, and return the same as rows of a JSON file."""
    rows = []
    for name, value in measured.items():
        threshold = THRESHOLDS[name]
        click.echo(threshold.line(value))
        rows.append(
            {
                "benchmark": benchmark,
                "figure": threshold.figure,
                "measured": value,
                "floor": threshold.bound,
                "aim": threshold.aim,
                "dtype": None,
                "status": "MET" if threshold.met(value) else "MISSED",
            }
        )
    return rows

"""Every equation, example and figure of the chapter that is quoted is the one that the chapter has under its number."""

import importlib
import re
from functools import reduce
from pathlib import Path

import pytest

import hjbjax as hjb

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "chapter.md").read_text(encoding="utf-8")
# what the chapter has under a number, as words of which one stands near every quotation
EQUATIONS = {
    "2.1": "pendulum|sin θ",
    "2.6": "gravity",
    "2.7": "closed|e\\^",
    "2.8": "torque|gravity|gains",
    "4.4": "bracket",
    "4.5": "reachab|bracket",
    "4.11": "observab|output",
    "5.4": "integrators|linear system",
    "5.5": "manipulator|M\\(q\\)|arm|accelerates",
    "5.6": "torque|M\\(q\\)",
    "6.6": "Pomet|x₁u₂",
    "6.7": "feedback",
    "6.8": "Lyapunov|V =|dV/dt",
    "8.4": "Pontryagin",
    "8.7": "Pontryagin|end condition",
    "8.10": "dynamic programming|principle of optimality",
    "8.11": "horizon",
    "8.14": "minimum.time|discount|least time",
    "9.2": "dynamic programming|solve",
    "9.4": "pendulum|gain",
    "10.1": "noise|dx = f",
    "10.4": "dynamic programming|second",
    "10.6": "noise",
    "11.3": "inequality|gain",
    "11.4": "inequality|gain",
    "11.6": "Isaacs|game",
    "11.7": "disturbance",
    "12.3": "observer|Luenberger",
    "12.4": "estimate",
    "12.6": "law of the state|Zakai|record",
    "12.7": "dynamic programming|law of the state",
    "12.10": "robust|dY/dt",
    "12.11": "robust|dY/dt",
    "13.3": "chain|probabilit|rates",
}
EXAMPLES = {
    "4.1": "controllable|rank|OneWay|x₁²|x\\[0\\]|tube|x_1", "4.2": "observab|Angle|sin", "6.1": "Pomet|feedback",
}  # fmt: skip
FIGURES = {
    3: "pendulum", 4: "gravity", 5: "stabilised|friction", 6: "park|switch", 7: "from v to z",
    8: "minimum.time|least time|value", 9: "switching|feedback", 10: "value|pendulum", 11: "feedback", 12: "trajectory",
    13: "estimate", 14: "law", 15: "robust", 16: "particle",
}  # fmt: skip
QUOTED = re.compile(r"(?<![\w.])\(((?:[2-9]|1[0-3])\.[1-9]\d?)\)")
SOURCES = [
    *(path for path in (ROOT / "docs").rglob("*.md") if path.name != "recorded.md"),
    *(ROOT / "notebooks").glob("*.py"),
    *(ROOT / "hjbjax").rglob("*.py"),
    ROOT / "README.md",
]


def near(lines, number):
    """The lines around a line, in which the words of a quotation are looked for."""
    return "\n".join(lines[max(0, number - 6) : number + 7])


def quotations():
    """The place, the list, the number and the surroundings of every quotation."""
    for path in SOURCES:
        lines = path.read_text(encoding="utf-8").splitlines()
        for k, line in enumerate(lines):
            place = f"{path.relative_to(ROOT)}:{k + 1}"
            if "jnp." not in line and "np." not in line:
                yield from ((place, EQUATIONS, number, near(lines, k)) for number in QUOTED.findall(line))
            yield from ((place, EXAMPLES, number, near(lines, k)) for number in re.findall(r"Example (\d\.\d)", line))
            yield from ((place, FIGURES, int(n), near(lines, k)) for n in re.findall(r"\b[Ff]igures? (\d+)\b", line))


def test_every_quotation_is_about_what_the_chapter_has_there():
    found = list(quotations())
    assert len(found) > 150
    unknown = [(place, number) for place, known, number, _ in found if number not in known]
    assert not unknown
    wrong = [
        (place, number) for place, known, number, text in found if not re.search(known[number], text, re.IGNORECASE)
    ]
    assert not wrong


def test_a_wrong_number_is_found():
    """The notebook on stochastic control once quoted (10.6), about small noise, for the equation (10.4)."""
    text = "The equation of dynamic programming has second derivatives."
    assert re.search(EQUATIONS["10.4"], text)
    assert not re.search(EQUATIONS["10.6"], text)


ROWS = re.findall(
    r"^\| (\(\d.*?\)|Example [\d.]+|Figure \d+) \| (.*?) \| `hjb\.(.*?)` \| .*?\((.*?)\) \| `(.*?)` \|$", PAGE, re.M
)


def test_the_page_has_every_number():
    wanted = [f"({n})" for n in EQUATIONS] + [f"Example {n}" for n in EXAMPLES] + [f"Figure {n}" for n in FIGURES]
    assert [row[0] for row in ROWS] == wanted
    words = [*EQUATIONS.values(), *EXAMPLES.values(), *FIGURES.values()]
    for (number, content, *_), word in zip(ROWS, words, strict=True):
        assert re.search(word, content, re.IGNORECASE), number


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_of_the_page_leads_somewhere(row):
    number, _, function, notebook, test = row
    importlib.import_module("hjbjax.filtering")
    assert reduce(getattr, function.split("."), hjb)
    assert (ROOT / "docs" / notebook).exists()
    assert (ROOT / test).exists()
    if number.startswith("Figure"):
        source = (ROOT / "notebooks" / f"{Path(notebook).stem}.py").read_text(encoding="utf-8")
        assert f"# ## {number}:" in source

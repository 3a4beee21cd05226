"""Docstrings as reStructuredText.

A docstring here is read in an editor: |V| is an absolute value, x* an optimum, and an equation stands on an indented
line. reStructuredText would take these for substitutions, emphasis and quotations.
"""

import re

SECTIONS = re.compile(r"^(Args|Keyword Args|Returns|Raises|Yields|Example|Examples|Attributes|Note):$")
LITERAL = re.compile(r"(``.*?``|:\w+:`[^`]*`)")
MARKS = re.compile(r"([\\|*`])|(?<=\w)(_)(?!\w)")


def escaped(line):
    """A line of prose with the characters that reStructuredText reads as markup taken literally, but for ``code``."""
    parts = LITERAL.split(line)
    return "".join(part if place % 2 else MARKS.sub(r"\\\1\2", part) for place, part in enumerate(parts))


def depth(line):
    """How far a line is indented."""
    return len(line) - len(line.lstrip())


def prepared(lines):
    """The lines of a docstring as reStructuredText: prose escaped, indented equations and doctests as they stand."""
    out, section, literal = [], False, None
    for number, line in enumerate(lines):
        blank = not line.strip()
        if literal is not None and not blank and depth(line) <= literal:
            literal = None
        if SECTIONS.match(line):
            section = True
        elif section and not blank and depth(line) == 0:
            section = False
        if literal is not None or blank or SECTIONS.match(line):
            out.append(line)
            continue
        after_blank = number > 0 and not lines[number - 1].strip()
        if line.lstrip().startswith(">>>"):
            literal = depth(line) - 1  # a doctest ends with a blank line; napoleon has its own eye for it
            out.append(line)
        elif not section and after_blank and depth(line) > 0:
            literal = 0
            out += ["::", "", line]
        else:
            out.append(escaped(line))
    return out


def prepare_docstring(app, what, name, obj, options, lines):
    """The event of autodoc: change ``lines`` in place."""
    lines[:] = prepared(lines)
    # napoleon takes what stands before a colon in the first line of a property for its type
    if what in ("property", "attribute") and lines and ":" in lines[0]:
        lines[0] = ": " + lines[0]

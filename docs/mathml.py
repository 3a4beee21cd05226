"""Equations as MathML, which browsers draw by themselves: no script, and nothing from a network."""

import re

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

SHORT = re.compile(r"\\([dt]?frac)\s*(\d)\s*(\d)")  # as in \tfrac12


def plain(tex):
    """An equation with braces where TeX can do without: docutils reads \\tfrac12 x as twelve over x."""
    return SHORT.sub(r"\\\1{\2}{\3}", tex)


def inline(translator, node):
    """An equation in a line of text."""
    translator.body.append(tex2mathml(plain(node.astext())))
    raise nodes.SkipNode


def block(translator, node):
    """An equation on a line of its own."""
    translator.body.append(f'<div class="math">{tex2mathml(plain(node.astext()), as_block=True)}</div>\n')
    raise nodes.SkipNode


def add(app):
    """Make it a renderer of Sphinx."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))

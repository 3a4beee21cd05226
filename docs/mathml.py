"""Equations as MathML, which browsers draw by themselves: no script, and nothing from a network."""

import html
import re
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

MATHML = "http://www.w3.org/1998/Math/MathML"
ENTITY = re.compile(r"&(?!lt;|gt;|amp;)\w+;")
SHORT = re.compile(r"\\([dt]?frac)\s*(\d)\s*(\d)")  # as in \tfrac12


def plain(tex):
    """An equation with braces where TeX can do without: docutils reads \\tfrac12 x as twelve over x."""
    return SHORT.sub(r"\\\1{\2}{\3}", tex)


def converted(tex, **options):
    """An equation in MathML, with subscripts of accented letters next to them: docutils puts both above and below."""
    ElementTree.register_namespace("", MATHML)
    markup = ENTITY.sub(lambda name: html.unescape(name[0]), tex2mathml(plain(tex), **options))  # XML has only three
    root = ElementTree.fromstring(markup)
    tag = f"{{{MATHML}}}".__add__
    for element in root.iter(tag("munderover")):
        letter, below, above = element
        if above.get("stretchy") == "false":  # an accent, and not the limits of a sum
            element.tag = tag("msub")
            accented = ElementTree.Element(tag("mover"), accent="true")
            accented.extend([letter, above])
            element[:] = [accented, below]
    return ElementTree.tostring(root, encoding="unicode")


def inline(translator, node):
    """An equation in a line of text."""
    translator.body.append(converted(node.astext()))
    raise nodes.SkipNode


def block(translator, node):
    """An equation on a line of its own."""
    translator.body.append(f'<div class="math">{converted(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def add(app):
    """Make it a renderer of Sphinx."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))

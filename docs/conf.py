"""Settings of Sphinx: Markdown pages, docstrings in Google's style, and figures without a network."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the checkout, whatever is installed

from docs import mathml
from docs.docstrings import prepare_docstring
from hjbjax import __version__

project = "hjbjax"
author = copyright = "The hjbjax developers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["generated/*"]  # included by pages that say more
nitpicky = True  # a reference that leads nowhere is a warning, and `python -m docs` makes an error of it

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3


autodoc_typehints = "description"  # in brackets after the name; shape and unit are in the text
autodoc_typehints_description_target = "documented_params"
nitpick_ignore_regex = [("py:class", ".*")]  # types in signatures have no entry of their own
copybutton_exclude = ".linenos, .gp, .go"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Keyword Args", "params_style")]

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"hjbjax {__version__}"
html_copy_source = html_show_sourcelink = False
html_static_path = ["static"]
html_css_files = ["site.css"]


# jaxtyping's types with a shape, for NumPy and for JAX; the shape is in the text
SHAPED = re.compile(r"~?[\w.]*?(\w+)\[[\w.~]*\.Array, '([^']*)'\] \| ~?[\w.]*?\1\[[\w.~]*ndarray, '\2'\]")


def shorten_types(app, *_):
    """Write ``Array`` for an array of either kind in the types of arguments, before autodoc adds them to the text."""
    for types in app.env.current_document.autodoc_annotations.values():
        types.update({name: SHAPED.sub("Array", text) for name, text in types.items()})


def setup(app):
    """Equations as MathML; docstrings, which are plain text, as reStructuredText before napoleon reads them."""
    mathml.add(app)
    app.connect("object-description-transform", shorten_types, priority=400)
    app.connect("autodoc-process-docstring", prepare_docstring, priority=100)

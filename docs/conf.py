"""The configuration of the documentation: `make docs` builds it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "agg")
sys.path[:0] = [str(Path(__file__).parent / "_extensions"), str(Path(__file__).parent)]

import matplotlib.pyplot as plt  # noqa: E402

import zakai  # noqa: E402

project = "zakai"
author = "The zakai authors"
copyright = "The zakai authors, Apache License 2.0"
version = release = zakai.__version__

extensions = [
    "myst_parser",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "executed_blocks",
    "notebooks",
    "docstring_examples",
]
exclude_patterns = ["_build", "_generated"]
templates_path: list[str] = []
nitpicky = False

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

# The extension marks formulas; KaTeX, from files in _static, draws them, so that the pages open without a network.
myst_update_mathjax = False
mathjax_path = "katex/katex.min.js"
mathjax_options = {"loading_method": "defer"}

autosummary_generate = True
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "member-order": "bysource"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
default_role = "code"

html_theme = "pydata_sphinx_theme"
html_title = "zakai"
html_static_path = ["_static"]
html_css_files = ["katex/katex.min.css", "zakai.css"]
html_js_files = [("formulas.js", {"defer": "defer"}), ("copy.js", {"defer": "defer"})]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 5,
    "show_nav_level": 2,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "tango",
    "pygments_dark_style": "monokai",
}
html_sidebars = {"index": []}

plt.rcParams.update(
    {
        "figure.figsize": (7.2, 3.4),
        "figure.constrained_layout.use": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": "medium",
        "font.size": 9,
        "savefig.facecolor": "white",
    }
)

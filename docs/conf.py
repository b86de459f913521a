"""Sphinx: the site is the Markdown beside this file; what the code knows better, docs/_extensions takes from it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

from service import VERSION

project = "hostlens"
author = "The hostlens developers"
copyright = "The hostlens developers"  # noqa: A001 - Sphinx's name
version = release = VERSION

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "generated",
]
exclude_patterns = ["_extensions"]


myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
# At each build: what a cell shows is the engine's, whose changes no cache would see.
nb_execution_mode = "force"
# Of a cell; on a busy machine it is slow and not wrong.
nb_execution_timeout = 1200
nb_execution_raise_on_error = True
nb_execution_show_tb = True

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
add_module_names = False

html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = "hostlens"
html_theme_options = {
    "navigation_with_keys": False,
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_show_sourcelink = False
html_sidebars = {"**": ["sidebar-nav-bs"], "index": []}
# Without the prompts and the answers, what is copied can be run.
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True
copybutton_line_continuation_character = "\\"

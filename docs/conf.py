"""Sphinx: `make docs` builds these pages and the API reference into runs/site."""

import os

os.environ.setdefault("MUJOCO_GL", "disable")

project = "touchgoal"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "touchgoal"
exclude_patterns = ["site"]
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_format = "short"
napoleon_use_ivar = True
myst_heading_anchors = 3
# Pages link to files outside docs/, as on GitHub.
suppress_warnings = ["myst.xref_missing"]

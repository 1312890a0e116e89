"""How Sphinx builds the site: `make docs` writes it to build/docs. It needs no network."""

import tomllib
from pathlib import Path

_PROJECT = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text("utf-8"))["project"]

project = "Overfly"
author = "the Overfly authors"
project_copyright = "the Overfly authors, Apache License 2.0"
version = release = _PROJECT["version"]

extensions = ["myst_parser"]
exclude_patterns = ["_build"]
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]
nitpicky = True
smartquotes = False
suppress_warnings: list[str] = []

html_theme = "furo"
html_title = f"Overfly {release}"
html_static_path = ["_static"]
html_css_files = ["overfly.css"]
html_theme_options = {"navigation_with_keys": True}
html_show_sphinx = False
html_copy_source = False
pygments_style, pygments_dark_style = "default", "monokai"

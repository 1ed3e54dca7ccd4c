"""Configuration of the documentation: `sphinx-build -W -b html docs build`.

Pages are Markdown files of docs/, written by hand, and those that are made at the start of every
build in docs/generated/: a reference from the code (reference.py), pictures (pictures.py), scripts
and scenes (gallery.py), and the pages of the repository outside docs/ (repository.py).
"""

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS), str(DOCS.parent), str(DOCS.parent / "tests")]

import gallery  # noqa: E402 - its folder is not a package
import pictures  # noqa: E402
import reference  # noqa: E402
import repository  # noqa: E402

from gftorf_warp import __version__  # noqa: E402

project = "gftorf_warp"
author = "gftorf_warp contributors"
copyright = author
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
root_doc = "index"

myst_heading_anchors = 4
linkcheck_ignore = [r"http://127\.0\.0\.1"]  # the viewer, while it runs
linkcheck_timeout = 20  # [s]
nb_execution_mode = "force"  # of docs/notebooks/, at every build, from nothing
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # [s] for a cell
nb_execution_show_tb = True
nb_merge_streams = True
highlight_language = "none"  # commands and what they print
smartquotes = False  # they make a dash of the two hyphens of an option

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = "gftorf_warp"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False


def generate(_app, _config) -> None:
    """Write docs/generated/ anew."""
    folder = DOCS / "generated"
    repository.write(folder)
    reference.write(folder)
    pictures.write(folder)
    gallery.write(folder)


def keep_colons(_app, what, _name, _thing, _options, lines) -> None:
    """Napoleon takes the first line of a field's docstring for its type if it has a colon."""
    if what == "attribute":
        lines.insert(0, "\\")  # nothing, in reStructuredText


def setup(app) -> None:
    """Connect what is made at build time."""
    app.connect("config-inited", generate)
    app.connect("autodoc-process-docstring", keep_colons, priority=400)  # before napoleon's 500
    app.connect("source-read", repository.resolve_links)

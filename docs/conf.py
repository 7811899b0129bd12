"""Configuration of the documentation site: ``python -m sphinx -W -b html docs OUT``."""

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from tools.site_pages import move_links, write_pages  # noqa: E402
from vehicle_detection import __version__  # noqa: E402

project = "vehicle_detection"
author = "The vehicle_detection authors"
copyright = f"2026 {author}"  # noqa: A001
version = release = __version__

extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
exclude_patterns = ["_readme", "_build"]
default_role = "py:obj"

myst_enable_extensions = ["colon_fence", "html_image"]
myst_heading_anchors = 3
nb_execution_mode = "off"

autosummary_generate = False
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Floats": "Floats", "FrameShape": "FrameShape"}
python_maximum_signature_line_length = 88
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

smartquotes_action = "qe"  # not dashes: --fov is an option
html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
# Pages without pages below them.
_SINGLE = ("start", "gallery", "concepts", "course", "cli", "files", "limits", "changelog")
html_sidebars: dict[str, list[str]] = {name: [] for name in _SINGLE}
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "footer_start": ["copyright"],
    "footer_end": [],
}


def _edit_source(_app: Sphinx, docname: str, source: list[str]) -> None:
    path = f"docs/{docname}.md"
    # Values and their errors stay in one line of a table's cell.
    text = re.sub(
        r"(?m)^\|.*", lambda row: row[0].replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}"), source[0]
    )
    source[0] = move_links(text, path, path)


# Readable forms of what type aliases and default factories evaluate to.
_SIGNATURE_FORMS = (
    (
        r"~?(?:numpy\.)?ndarray\[tuple\[~?(?:typing\.)?Any, \.\.\.\], ~?(?:numpy\.)?dtype\[~?([\w.]+)\]\]",
        r"NDArray[\1]",
    ),
    (r"~?(?:[\w.]+\.)?TypeAliasForwardRef\('(\w+)'\)", r"\1"),
    (r"<factory>", "..."),
)


def _shorten_signature(
    _app: Sphinx,
    _kind: str,
    _name: str,
    _value: object,
    _options: object,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    for pattern, form in _SIGNATURE_FORMS:
        signature = signature and re.sub(pattern, form, signature)
        returns = returns and re.sub(pattern, form, returns)
    return signature, returns


def setup(app: Sphinx) -> None:
    """Generate pages before sources are read, and edit these."""
    write_pages(DOCS)
    app.connect("source-read", _edit_source)
    app.connect("autodoc-process-signature", _shorten_signature)

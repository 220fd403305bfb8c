"""Executed notebooks as pages of the site: /notebooks/1_quickstart.html and so on, made by nbconvert.

A page needs no network: nbconvert's scripts from content delivery networks are left out, and formulas become MathML.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from jinja2 import pass_context
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import HTMLExporter

_FOLDER = Path(__file__).parent.parent / "notebooks"
_FORMULA = re.compile(r"<[^>]*>|(\$\$?)([^$]+)\1")
"""A formula, or a tag: the identifiers of headings hold dollars too."""
_SCRIPT = re.compile(
    r'<script[^>]*\bsrc="https?://[^>]*>\s*</script>|<script type="(?:module|text/x-mathjax-config)">.*?</script>',
    re.DOTALL,
)
"""Scripts from elsewhere and for them: require.js, MathJax, and a module that loads Mermaid's diagrams."""
_ELSEWHERE = re.compile(r'<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)="https?://[^"]*|@import [^;]*https?://[^;]*')
"""Pattern of links that a browser would fetch from another host."""


class _Page(HTMLExporter):
    """Exporter whose pages have formulas as MathML and load nothing."""

    @pass_context
    def markdown2html(self, context: Any, source: str) -> str:
        """Return a cell of text as HTML."""
        return _FORMULA.sub(_as_mathml, super().markdown2html(context, source))


def _as_mathml(found: re.Match[str]) -> str:
    if found[1] is None:
        return found[0]
    return convert(html.unescape(found[2]), display="block" if found[1] == "$$" else "inline")


def page_of(notebook: Path) -> str:
    """Return the page of an executed notebook.

    Raises:
        ValueError: the page would load something from another host.
    """
    page = _SCRIPT.sub("", _Page().from_filename(str(notebook))[0])
    if loads := _ELSEWHERE.search(page):
        raise ValueError(f"the page of {notebook.name} loads {loads[0]}; add its tag to _SCRIPT")
    return page


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook; mkdocs calls this once the folder of pages is read."""
    for notebook in sorted(_FOLDER.glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{notebook.stem}.html", content=page_of(notebook)))
    return files

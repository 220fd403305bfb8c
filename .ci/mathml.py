"""Mathematics of the pages as MathML, made when the site is built: a browser needs no script and no network for it."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
"""What ``pymdownx.arithmatex`` makes of ``$...$`` and ``$$...$$``."""


def on_page_content(content: str, **_: Any) -> str:
    """Called by mkdocs with each page, once it is HTML."""
    return _FORMULA.sub(_as_mathml, content)


def _as_mathml(found: re.Match[str]) -> str:
    tag, formula = found[1], html.unescape(found[2])
    return f'<{tag} class="formula">{convert(formula, display="block" if tag == "div" else "inline")}</{tag}>'

"""MkDocs hook: turns formulas into MathML while the pages are built, so that they need no script to show."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(page_html: str, **_: Any) -> str:
    """Replace what pymdownx.arithmatex marked as formulas."""
    page_html = _BLOCK.sub(lambda match: convert(html.unescape(match[1]), display="block"), page_html)
    return _INLINE.sub(lambda match: convert(html.unescape(match[1])), page_html)

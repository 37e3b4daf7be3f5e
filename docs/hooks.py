"""What the site needs besides mkdocs.yml: links out of docs/ made plain, comments of fields taken for docstrings."""

from __future__ import annotations

import posixpath
import re
from typing import Any

import griffe

_LINK = re.compile(r"(?<!!)\[[^\]\n]*\]\((\.\./[^)\s]+)\)")
_COMMENT = re.compile(r"[^#]*  # (.+)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replaces links out of docs/, which lead somewhere in the repository only, by the path there, as code."""
    folder = posixpath.join("docs", posixpath.dirname(page.file.src_uri))

    def replace(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, match[1]))
        return match[0] if path.startswith("docs/") else f"`{path}`"

    return _LINK.sub(replace, markdown)


class Comments(griffe.Extension):
    """Takes the comment behind a field or constant, or the lines above a constant, for its docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring is not None or attr.lineno is None or attr.parent is None:
            return
        lines, row = attr.lines_collection[attr.filepath], attr.lineno - 1
        first = row
        while attr.parent.is_module and lines[first - 1].startswith("# "):
            first -= 1
        if not lines[row].lstrip().startswith(attr.name):  # `self.name = ...`
            return
        behind = _COMMENT.fullmatch(lines[row])
        comment = [behind[1]] if behind else [line[2:] for line in lines[first:row]]
        if comment:
            attr.docstring = griffe.Docstring("\n".join(comment), parent=attr, lineno=attr.lineno)

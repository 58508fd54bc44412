"""MkDocs hook: two pages of the site are README files of the repository, and each exists once.

The README files link to source files, which the site does not contain. Such a link becomes its text and the path of the
file; a link between the two README files becomes a link between the two pages.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

PAGES = {"protocol.md": "protocol/README.md", "firmware.md": "firmware/README.md"}
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_page_read_source(page: Any, config: Any) -> str | None:
    """The text of a page whose source is a README file; None for all other pages."""
    source = PAGES.get(page.file.src_uri)
    if source is None:
        return None
    top = posixpath.join(posixpath.dirname(config["config_file_path"]), "..")
    return rewrite_links(Path(top, source).read_text(encoding="utf-8"), source)


def rewrite_links(text: str, source: str) -> str:
    """`text`, a README at `source` in the repository, with its relative links rewritten for the site."""
    page_of = {readme: page for page, readme in PAGES.items()}

    def rewrite(match: re.Match[str]) -> str:
        label, target, anchor = match[1], match[2], match[3] or ""
        if "://" in target:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        for readme, page in page_of.items():
            if path in (readme, posixpath.dirname(readme)):
                return f"[{label}]({page}{anchor})"
        if path.startswith("host/docs/"):
            return f"[{label}]({path.removeprefix('host/docs/')}{anchor})"
        return label if label.strip("`") == path else f"{label} (`{path}`)"

    return _LINK.sub(rewrite, text)

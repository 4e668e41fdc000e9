"""What MkDocs does not know of this tree: pages made from the code, and files outside `docs/`.

A link from a page to a file of the source tree leads to that file as it stands, under `source/`;
README.md is the first page of the site.
"""

from __future__ import annotations

import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import bampipe

sys.path.insert(0, str(Path(__file__).parent))
import reference

ROOT = Path(__file__).parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)]*)?\))")


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages, those at the top of the tree, and every file linked from a page."""
    for name, text in reference.pages().items():
        files.append(File.generated(config, f"reference/{name}", content=text))
    for name, page in PAGES.items():
        files.append(
            File.generated(config, page, content=(ROOT / name).read_text(encoding="utf-8"))
        )
    linked = {
        source_of(target, page.src_uri)
        for page in files.documentation_pages()
        for _, target, _ in LINK.findall(page.content_string)
        if "://" not in target
    }
    for source in sorted(linked):
        if not source.startswith("docs/") and source not in PAGES and (ROOT / source).is_file():
            address = address_of(source)
            files.append(File.generated(config, address, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links between files of the tree into links between files of the site."""

    def turned(match: re.Match[str]) -> str:
        target = match[2]
        if "://" in target or page.file.src_uri.startswith("reference/"):
            return match[0]
        address = address_of(source_of(target, page.file.src_uri))
        here = posixpath.dirname(page.file.src_uri)
        return match[1] + posixpath.relpath(address, here or ".") + match[3]

    return LINK.sub(turned, markdown)


def source_of(target: str, page: str) -> str:
    """Path in the source tree of what the page ``page`` of the site links as ``target``."""
    home = next((name for name, made in PAGES.items() if made == page), f"docs/{page}")
    return posixpath.normpath(posixpath.join(posixpath.dirname(home), target))


def address_of(source: str) -> str:
    """Path in the site of the file ``source`` of the source tree."""
    if source in PAGES:
        return PAGES[source]
    if source.startswith("docs/"):
        return source.removeprefix("docs/")
    return f"source/{source.lstrip('.')}.txt"  # to be read, not downloaded


def on_config(config: Any) -> Any:
    """Say of which version the pages are, and give the same bytes on any day."""
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    config.copyright = f"bampipe {bampipe.__version__}"
    return config
